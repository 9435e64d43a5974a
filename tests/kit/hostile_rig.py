"""Keyframes of a robot that lies about its rig or its IMU, and the map of it and three honest robots."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rse_pf.errors import RsePfError
from rse_pf.geometry import Array
from rse_pf.live_map.events import KeyframeAdded
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.outcomes import Added, OptimiseWanted
from rse_pf.slam.inertial import InertialMotion, KeyframeImu
from rse_pf.slam.keyframe import SentKeyframe, UnknownBlock, decode_keyframe, encode_keyframe, make_features
from tests.kit.synthetic_maps import make_world

HOSTILE = "x"
_UNKNOWN_KIND, _IMU_KIND = 77, 6
_BLOCK = struct.Struct("<HHI")
_BLOCKS_AT = 3
_F_BASELINE = 50.0

Drives = Mapping[str, tuple[bytes, ...]]
"""The encoded keyframes of each robot, in order."""
Attack = Callable[[int, SentKeyframe], bytes]
"""Returns the bytes that the robot sends for keyframe *number*."""


@dataclass(slots=True, eq=False)
class Outcome:
    """A map: poses of the honest keyframes by robot and number, and what became of the hostile ones."""

    poses: dict[tuple[str, int], Array] = field(default_factory=dict)
    refused: int = 0
    accepted: int = 0
    has_joined: bool = False
    why: str = ""


def generated_drives(seed: int, keyframes: int = 16) -> Drives:
    """Return three honest robots and a hostile one in a generated hall; each drives a third of a round."""
    world, drives = make_world(seed, points=4000), {}
    for row, name in enumerate(("a", "b", "c", HOSTILE)):
        turns = 0.27 * (row if name != HOSTILE else 0.5) + np.linspace(0.0, 0.35, keyframes)
        version, _ = world.walk(name, turns, seed=10 * seed + row)
        drives[name] = tuple(
            encode_keyframe(SentKeyframe.from_map(keyframe)) for keyframe in version.keyframes
        )
    return drives


def play(drives: Drives, attack: Attack | None) -> Outcome:
    """Return the map of all robots that drive at the same time; without an attack no robot is hostile."""
    live_map, played = LiveMap(), Outcome()
    ids: dict[tuple[str, int], int] = {}
    for number in range(len(drives["a"])):
        for name, keyframes in drives.items():
            data, is_hostile = keyframes[number], name == HOSTILE
            if is_hostile and attack is None:
                continue
            if is_hostile:
                data = attack(number, decode_keyframe(data))
            next_number = live_map.next_number(name) if is_hostile else number
            event = KeyframeAdded(robot=name, segment=0, number=next_number, data=data)
            try:
                live_map.check_keyframe(event)
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
    aligned = {each.robot: each.aligned for each in live_map.alignments()}
    played.has_joined = aligned.get(HOSTILE, False)
    return played


def tell_truth(number: int, keyframe: SentKeyframe) -> bytes:
    return encode_keyframe(keyframe)


def _with_block(keyframe: SentKeyframe, kind: int, content: bytes, flags: int = 0) -> bytes:
    """Return an encoded keyframe with one more block after its own ones."""
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


def _moved(keyframe: SentKeyframe, T_odom_camera: Array) -> bytes:
    return encode_keyframe(replace(keyframe, T_odom_camera=T_odom_camera))


def _with_baseline(keyframe: SentKeyframe, f_baseline: float) -> bytes:
    """Return a keyframe with the depths of a stereo pair."""
    seen = keyframe.features
    features = make_features(seen.pixels, seen.depths_m, seen.descriptors, seen.noise, seen.kind, f_baseline)
    return encode_keyframe(replace(keyframe, features=features))


def jump(number: int, keyframe: SentKeyframe) -> bytes:
    """Return a keyframe whose odometry is 3 m aside, if it is every fifth one."""
    T = keyframe.T_odom_camera.copy()
    T[:3, 3] += (3.0 if number % 5 == 4 else 0.0) * T[:3, 0]
    return _moved(keyframe, T)


_NAN, _INFINITE = float("nan"), float("inf")
_GOOD_IMU = [0.0, 1.0, 0.0, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
REFUSED: dict[str, Attack] = {
    "nan-pose": lambda number, keyframe: _moved(keyframe, np.full((4, 4), _NAN)),
    "nan-gravity": _imu_numbers([_NAN, *_GOOD_IMU[1:]]),
    "infinite-motion": _imu_numbers([*_GOOD_IMU, 0.5, *[_INFINITE] * 60]),
    "arm-of-1-km": _imu_numbers([*_GOOD_IMU[:7], 1e3, 0.0, 0.0]),
    "10^6-samples": lambda number, keyframe: _with_block(keyframe, _IMU_KIND, bytes(24 * 10**6)),
    "1,000-samples": lambda number, keyframe: _with_block(keyframe, _IMU_KIND, bytes(24 * 10**3)),
    "negative-baseline": lambda number, keyframe: _with_baseline(keyframe, _F_BASELINE).replace(
        struct.pack("<d", _F_BASELINE), struct.pack("<d", -_F_BASELINE)
    ),
    "unknown-required": lambda number, keyframe: _with_block(keyframe, _UNKNOWN_KIND, b"rig", flags=1),
}
"""Attacks whose keyframes are all refused."""
ACCEPTED: dict[str, Attack] = {
    "unknown-optional": lambda number, keyframe: encode_keyframe(
        replace(keyframe, unknown_blocks=(UnknownBlock(_UNKNOWN_KIND, bytes(1000)),))
    ),
    "false-gravity": _imu([1.0, 0.0, 0.0]),
    "false-motion": _imu([0.0, 1.0, 0.0], arm_m=9.9, motion=_FALSE_MOTION),
}
"""Attacks whose keyframes are accepted, and move no other robot."""
