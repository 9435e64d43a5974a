"""A robot that lies about its rig or its IMU, beside honest robots of its live map: how far are they moved?

Three honest robots drive through the red kitchen, and a fourth one through the middle of it, whose keyframes
are changed before they are sent.  The errors of the honest robots are compared with those of the same map
without the fourth robot, and with the map in which it tells the truth.

    python -m benchmarks live.hostile_rigs [--recordings ../shared/data] [--attack NAME ...]
    python -m benchmarks live.hostile_rigs --platform

``--platform`` sends the same keyframes through a local platform with two servers, in the order and at the
rate of the recording, and compares the maps that it publishes.  Without a recording the robots drive through
a generated hall.

Defends: what is refused changes nothing; beside what is accepted the error of the honest robots grows by at
most 0.1 cm.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.live.one_process import DENSE, KITCHEN_CUTS
from benchmarks.maps.recordings import Run, drive, red_kitchen, truth_of
from client_sdk import connect
from client_sdk.robot import Robot
from client_sdk.transfer.data_client import DataClient
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.experiments.results.trajectory_error import ate_m
from rse_pf.geometry import Array, scaled
from rse_pf.live_map.events import KeyframeAdded, RobotForgotten
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.outcomes import Added, OptimiseWanted
from rse_pf.live_map.versions import encode_stored
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.maps.format import decode_map
from rse_pf.slam.inertial import InertialMotion, KeyframeImu
from rse_pf.slam.keyframe import (
    Keyframe,
    UnknownBlock,
    decode_keyframe,
    encode_keyframe,
    make_features,
    make_scaleless_features,
)
from tests.synthetic_maps import make_world

__all__ = [
    "ATTACKS",
    "HOSTILE",
    "Outcome",
    "SentDrive",
    "generated_drives",
    "kitchen_drives",
    "play",
    "tell_truth",
    "worse_cm",
]

HOSTILE = "x"
BAR_CM = 0.1
_RATE_HZ = 10.0
_HOSTILE_ROWS = range(50, 210)
_EVERY = 5
_UNKNOWN_KIND, _IMU_KIND = 77, 6
_BLOCK = struct.Struct("<HHI")
_BLOCKS_AT = 3
_F_BASELINE = 50.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SentDrive:
    """A robot's keyframes as bytes, the tick at which each is sent, and their ``(n, 4, 4)`` true poses."""

    keyframes: tuple[bytes, ...]
    ticks: tuple[int, ...]
    T_true: Array


@dataclass(slots=True, eq=False)
class Outcome:
    """A map: poses of the honest keyframes by robot and number, and what became of the hostile ones.

    ``apart`` are the honest robots that are not in it; ``after_forget`` are the poses after the hostile robot
    was forgotten.
    """

    poses: dict[tuple[str, int], Array] = field(default_factory=dict)
    refused: int = 0
    accepted: int = 0
    has_joined: bool = False
    why: str = ""
    apart: tuple[str, ...] = ()
    after_forget: dict[tuple[str, int], Array] = field(default_factory=dict)
    apart_after_forget: tuple[str, ...] = ()


Attack = Callable[[int, Keyframe], bytes]
"""Returns the bytes that the robot sends for keyframe *number*."""


def kitchen_drives(recordings: Path) -> dict[str, SentDrive]:
    """Return three honest robots in the red kitchen, and the hostile one that drives beside them."""
    dataset = red_kitchen(recordings)
    runs = {name: drive(dataset, rows, name, DENSE) for name, rows in KITCHEN_CUTS.items()}
    runs[HOSTILE] = drive(dataset, _HOSTILE_ROWS, HOSTILE, DENSE)
    return {name: _of_run(run, truth_of(dataset, run.stamps_s)) for name, run in runs.items()}


def _of_run(run: Run, T_true: Array) -> SentDrive:
    firsts = np.searchsorted(run.keyframe_of_frame, np.arange(len(run.version.keyframes)))
    return SentDrive(
        keyframes=tuple(encode_stored(keyframe) for keyframe in run.version.keyframes),
        ticks=tuple(int(row) for row in firsts), T_true=T_true[firsts],
    )  # fmt: skip


def generated_drives(seed: int, keyframes: int = 16) -> dict[str, SentDrive]:
    """Return the same of a generated hall, in which each robot drives a third of a round."""
    world, drives = make_world(seed, points=4000), {}
    for row, name in enumerate(("a", "b", "c", HOSTILE)):
        turns = 0.27 * (row if name != HOSTILE else 0.5) + np.linspace(0.0, 0.35, keyframes)
        version, truth = world.walk(name, turns, seed=10 * seed + row)
        drives[name] = SentDrive(
            keyframes=tuple(encode_stored(keyframe) for keyframe in version.keyframes),
            ticks=tuple(range(keyframes)), T_true=truth,
        )  # fmt: skip
    return drives


# --- attacks --------------------------------------------------------------------------------------


def tell_truth(number: int, keyframe: Keyframe) -> bytes:
    return encode_keyframe(keyframe)


def _with_block(keyframe: Keyframe, kind: int, content: bytes, flags: int = 0) -> bytes:
    """Return a keyframe with one more block behind its own, whatever the block holds."""
    data = bytearray(encode_keyframe(keyframe))
    data[_BLOCKS_AT] += 1
    return bytes(data) + _BLOCK.pack(kind, flags, len(content)) + content


def _imu_numbers(values: Sequence[float]) -> Attack:
    content = np.array(values, dtype="<f4").tobytes()
    return lambda number, keyframe: _with_block(keyframe, _IMU_KIND, content)


def _imu(down: Sequence[float], arm_m: float = 0.0, motion: InertialMotion | None = None) -> Attack:
    T_imu_camera = np.eye(4)
    T_imu_camera[0, 3] = arm_m
    imu = KeyframeImu(
        down_camera=np.array(down), deviation_rad=1e-3, T_imu_camera=T_imu_camera, motion=motion
    )
    return lambda number, keyframe: encode_keyframe(replace(keyframe, imu=imu))


_FALSE_MOTION = InertialMotion(
    duration_s=0.5, rotation=np.array([0.0, 3.0, 0.0]), velocity=np.full(3, 900.0), position=np.full(3, 9e3),
    bias_gyro=np.full(3, 9.0), bias_accel=np.full(3, -9.0), covariance=1e-8 * np.eye(9),
)  # fmt: skip


def _moved(keyframe: Keyframe, T_odom_camera: Array) -> bytes:
    return encode_keyframe(replace(keyframe, T_odom_camera=T_odom_camera))


def _with_depths(keyframe: Keyframe, factor: float, f_baseline: float = 0.0) -> Keyframe:
    """Return a keyframe whose depths are *factor* times as far, as of a stereo pair with an *f_baseline*."""
    seen = keyframe.features
    features = make_features(
        seen.pixels, factor * seen.depths_m, seen.descriptors, seen.noise, seen.kind, f_baseline
    )
    return replace(keyframe, features=features)


def _without_scale(keyframe: Keyframe, depths: float, odometry: float) -> bytes:
    """Return a keyframe of one lens, whose depths and odometry are so many times what they are in metres."""
    seen = keyframe.features
    features = make_scaleless_features(seen.pixels, depths * seen.depths_m, seen.descriptors, seen.kind)
    T = scaled(keyframe.T_odom_camera, odometry)
    return encode_keyframe(replace(keyframe, features=features, T_odom_camera=T))


def _false_metres(factor: float) -> Attack:
    """Claim metres that are *factor* times the true ones: of depths and odometry alike."""
    return lambda number, keyframe: _moved(
        _with_depths(keyframe, factor), scaled(keyframe.T_odom_camera, factor)
    )


def _false_baseline(factor: float) -> Attack:
    """State a baseline that is *factor* times the true one, beside the true odometry."""
    return lambda number, keyframe: encode_keyframe(
        _with_depths(keyframe, factor, f_baseline=factor * _F_BASELINE)
    )


def _at_some(attack: Attack, otherwise: Attack = tell_truth) -> Attack:
    return lambda number, keyframe: (attack if number % _EVERY == _EVERY - 1 else otherwise)(number, keyframe)


def _shifted(metres: float) -> Attack:
    def send(number: int, keyframe: Keyframe) -> bytes:
        T = keyframe.T_odom_camera.copy()
        T[:3, 3] += T[:3, 0] * metres
        return _moved(keyframe, T)

    return send


def _one_lens(depths: float = 2.0, odometry: float = 2.0) -> Attack:
    return lambda number, keyframe: _without_scale(keyframe, depths, odometry)


_NAN, _INFINITE = float("nan"), float("inf")
_GOOD_IMU = [0.0, 1.0, 0.0, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
REFUSED: dict[str, Attack] = {
    "nan-pose": lambda number, keyframe: _moved(keyframe, np.full((4, 4), _NAN)),
    "nan-gravity": _imu_numbers([_NAN, *_GOOD_IMU[1:]]),
    "infinite-motion": _imu_numbers([*_GOOD_IMU, 0.5, *[_INFINITE] * 60]),
    "arm-of-1-km": _imu_numbers([*_GOOD_IMU[:7], 1e3, 0.0, 0.0]),
    "10^6-samples": lambda number, keyframe: _with_block(keyframe, _IMU_KIND, bytes(24 * 10**6)),
    "1,000-samples": lambda number, keyframe: _with_block(
        _with_depths(keyframe, 1.0), _IMU_KIND, bytes(24 * 10**3)
    ),
    "negative-baseline": lambda number, keyframe: encode_keyframe(
        _with_depths(keyframe, 1.0, f_baseline=_F_BASELINE)
    ).replace(struct.pack("<d", _F_BASELINE), struct.pack("<d", -_F_BASELINE)),
    "unknown-required": lambda number, keyframe: _with_block(keyframe, _UNKNOWN_KIND, b"rig", flags=1),
}  # fmt: skip
"""Every keyframe of these is refused."""
ATTACKS: dict[str, Attack] = {
    **REFUSED,
    "unknown-optional": lambda number, keyframe: encode_keyframe(
        replace(keyframe, others=(UnknownBlock(_UNKNOWN_KIND, bytes(1000)),))
    ),
    "false-gravity": _imu([1.0, 0.0, 0.0]),
    "false-motion": _imu([0.0, 1.0, 0.0], arm_m=9.9, motion=_FALSE_MOTION),
    "metres-x0.5": _false_metres(0.5),
    "metres-x0.95": _false_metres(0.95),
    "metres-x1.02": _false_metres(1.02),
    "metres-x1.1": _false_metres(1.1),
    "metres-x2": _false_metres(2.0),
    "baseline-x0.9": _false_baseline(0.9),
    "baseline-x1.1": _false_baseline(1.1),
    "baseline-x1.5": _false_baseline(1.5),
    "some-metres-x1.3": _at_some(
        lambda number, keyframe: encode_keyframe(_with_depths(keyframe, 1.3))
    ),
    "some-poses-0.3-m": _at_some(_shifted(0.3)),
    "some-poses-3-m": _at_some(_shifted(3.0)),
    "one-lens": _one_lens(),
    "one-lens, depths-x1.3": _one_lens(depths=2.6),
    "one-lens, some-depths-x1.5": _at_some(_one_lens(depths=3.0), _one_lens()),
    "one-lens, unit-grows": lambda number, keyframe: _without_scale(
        keyframe, 2.0 * 1.02**number, 2.0 * 1.02**number
    ),
}  # fmt: skip


# --- playing --------------------------------------------------------------------------------------


def order_of(drives: Mapping[str, SentDrive], attack: Attack | None) -> list[tuple[int, str, int, bytes]]:
    """Return tick, robot, number and bytes of all keyframes in the order of sending; honest robots first.

    Without an attack there is no hostile robot.
    """
    order = []
    for name, each in drives.items():
        if name == HOSTILE and attack is None:
            continue
        for number, (tick, data) in enumerate(zip(each.ticks, each.keyframes, strict=True)):
            if name == HOSTILE and attack is not None:
                data = attack(number, decode_keyframe(data))
            order.append((tick, name, number, data))
    return sorted(order, key=lambda row: row[:3])


def play(drives: Mapping[str, SentDrive], attack: Attack | None) -> Outcome:
    """Return the map of all robots, made in this process."""
    live_map, played = LiveMap(), Outcome()
    ids: dict[tuple[str, int], int] = {}
    for _, name, number, data in order_of(drives, attack):
        is_hostile = name == HOSTILE
        event = KeyframeAdded(
            robot=name, segment=0, number=live_map.next_number(name) if is_hostile else number, data=data
        )
        try:
            live_map.judge(event)
        except RsePfError as error:
            played.refused += 1
            played.why = error.message
            continue
        added = next(each for each in live_map.apply(event) if isinstance(each, Added))
        outcomes = live_map.apply(live_map.measure(added.id))
        if any(isinstance(each, OptimiseWanted) for each in outcomes):
            live_map.apply(live_map.optimise())
        if is_hostile:
            played.accepted += 1
        else:
            ids[name, number] = added.id
    live_map.apply(live_map.optimise())
    played.poses = {key: live_map.pose(i) for key, i in ids.items() if live_map.is_in_map(i)}
    played.has_joined, played.apart = _joined(live_map)
    if played.accepted:
        live_map.apply(RobotForgotten(robot=HOSTILE))
        live_map.apply(live_map.optimise())
        played.after_forget = {key: live_map.pose(i) for key, i in ids.items() if live_map.is_in_map(i)}
        _, played.apart_after_forget = _joined(live_map)
    return played


def _joined(live_map: LiveMap) -> tuple[bool, tuple[str, ...]]:
    """Return whether the hostile robot is in a map, and the honest ones that are not."""
    known = {each.robot: each.aligned for each in live_map.alignments()}
    apart = sorted(name for name, is_aligned in known.items() if name != HOSTILE and not is_aligned)
    return known.get(HOSTILE, False), tuple(apart)


async def play_on(
    platform: LocalPlatform, map_name: str, drives: Mapping[str, SentDrive], attack: Attack | None
) -> Outcome:
    """Return the map that a platform publishes of all robots, at the rate of the recording."""
    played, began = Outcome(), time.monotonic()
    numbers: dict[str, int] = {}
    async with _connected(platform, [name for name in drives if name != HOSTILE or attack]) as robots:
        for tick, name, number, data in order_of(drives, attack):
            await asyncio.sleep(max(0.0, began + tick / _RATE_HZ - time.monotonic()))
            sent = numbers.get(name, 0) if name == HOSTILE else number
            request = {"map": map_name, "segment": 0, "number": sent, "keyframe": data}
            try:
                await robots[name].call("live-keyframe", request, deadline_s=10.0, keep=True)
            except RsePfError as error:
                if name != HOSTILE:
                    raise
                played.refused += 1
                played.why = f"{error.code}: {error.message}"
                continue
            numbers[name] = sent + 1
            played.accepted += name == HOSTILE
    token = platform.issue_token("operator")
    async with connect(platform.url, token=token) as operator:
        published = (await operator.call("live-publish", {"map": map_name}, deadline_s=60.0)).reply
        shown = (await operator.call("live-show", {"map": map_name}, deadline_s=60.0)).reply
        client = DataClient(platform.url, token)
        try:
            data = await asyncio.to_thread(client.download_map, map_name, str(published["version"]))
        finally:
            client.close()
        await operator.call("live-stop", {"map": map_name}, deadline_s=60.0)
    made = decode_map(data)
    times = {
        name: [decode_keyframe(each).timestamp_s for each in sent.keyframes] for name, sent in drives.items()
    }
    for keyframe in made.keyframes:
        if keyframe.robot in times and keyframe.robot != HOSTILE:
            number = int(np.argmin(np.abs(np.array(times[keyframe.robot]) - keyframe.timestamp_s)))
            played.poses[keyframe.robot, number] = keyframe.T_world_camera
    played.has_joined = any(row["robot"] == HOSTILE and row["aligned"] for row in shown["robots"])
    played.apart = tuple(
        row["robot"] for row in shown["robots"] if row["robot"] != HOSTILE and not row["aligned"]
    )
    return played


@contextlib.asynccontextmanager
async def _connected(platform: LocalPlatform, names: Sequence[str]) -> AsyncIterator[dict[str, Robot]]:
    async with contextlib.AsyncExitStack() as stack:
        yield {
            name: await stack.enter_async_context(
                connect(platform.url, token=platform.issue_token(name), codec="bin")
            )
            for name in names
        }


# --- figures --------------------------------------------------------------------------------------


def errors_cm(
    drives: Mapping[str, SentDrive], poses: Mapping[tuple[str, int], Array], keys: Sequence[tuple[str, int]]
) -> float:
    """Return the ATE of honest keyframes *keys* after one alignment of all of them."""
    made = np.array([poses[key] for key in keys])
    return 100.0 * ate_m(made, np.array([drives[name].T_true[number] for name, number in keys]))


def worse_cm(
    drives: Mapping[str, SentDrive], poses: Mapping[tuple[str, int], Array], others: Sequence[Outcome]
) -> tuple[float, float]:
    """Return by how much honest poses are worse than in the worst of *others*, and how far they moved.

    The second number is the ATE of the poses against those of the first of *others*.
    """
    keys = sorted(set(poses).intersection(*(each.poses for each in others)))
    worst = max(errors_cm(drives, each.poses, keys) for each in others)
    now, before = (np.array([each[key] for key in keys]) for each in (poses, others[0].poses))
    return errors_cm(drives, poses, keys) - worst, 100.0 * ate_m(now, before)


def row_of(
    name: str, drives: Mapping[str, SentDrive], attacked: Outcome, others: Sequence[Outcome]
) -> dict[str, Any]:
    """Return what an attack did; harm is how far honest poses moved, or became worse if it was accepted."""
    worse, moved = worse_cm(drives, attacked.poses, others)
    row = {
        "attack": name, "refused": attacked.refused, "accepted": attacked.accepted,
        "has_joined": attacked.has_joined, "worse_cm": worse, "moved_cm": moved,
        "harm_cm": worse if attacked.accepted else moved, "apart": list(attacked.apart),
    }  # fmt: skip
    if attacked.after_forget:
        left, _ = worse_cm(drives, attacked.after_forget, others[:1])
        row["after_forget"] = {"worse_cm": left, "apart": list(attacked.apart_after_forget)}
    say(row)
    return row


@benchmark(
    Bar("rows.*.harm_cm", at_most=BAR_CM, unit="cm"),
    Bar("rows.*.apart", equals=[]),
)
def run_benchmark(
    *, recordings: Path = Path("../shared/data"),
    attack: Annotated[tuple[str, ...], "attacks", ATTACKS] = (),
    seeds: Annotated[int, "generated halls, where there is no recording"] = 3, platform: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Play all attacks."""
    names = attack or tuple(ATTACKS)
    if recordings.is_dir():
        places = [kitchen_drives(recordings)]
    else:
        places = [generated_drives(seed) for seed in range(seeds)]
    if platform:
        with tempfile.TemporaryDirectory() as folder:
            return {"rows": asyncio.run(_all_on_platform(places[0], names, Path(folder)))}
    rows, honest = [], []
    for drives in places:
        others = [play(drives, None), play(drives, tell_truth)]
        keys = sorted(set(others[0].poses) & set(others[1].poses))
        without, truthful = (errors_cm(drives, each.poses, keys) for each in others)
        honest.append({"without_it_cm": without, "beside_the_truth_cm": truthful})
        rows += [row_of(name, drives, play(drives, ATTACKS[name]), others) for name in names]
    return {"honest": honest, "rows": rows}


async def _all_on_platform(
    drives: Mapping[str, SentDrive], names: Sequence[str], folder: Path
) -> list[dict[str, Any]]:
    async with LocalPlatform(
        PlatformSettings(), servers=2, port=0, state=folder / "platform", data=True
    ) as platform:
        others = [
            await play_on(platform, name, drives, attack)
            for name, attack in (("without", None), ("truthful", tell_truth))
        ]
        again = await play_on(platform, "again", drives, None)
        rows = [row_of("again without it", drives, again, others)]
        for number, name in enumerate(names):
            attacked = await play_on(platform, f"attack-{number}", drives, ATTACKS[name])
            rows.append(row_of(name, drives, attacked, others))
        return rows
