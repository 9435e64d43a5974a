"""Robots in two rendered rooms of equal furniture and textures: whom does a live map join, and when?

    python -m benchmarks live.equal_rooms prepare [--features DIR] [--seeds 20]
    python -m benchmarks live.equal_rooms run [--features DIR] [--seeds 20]

``prepare`` renders and tracks three robots for each seed (35 CPU seconds, 5 MB), and keeps their keyframes:
one in each of two equal rooms with other rooms around them, and one that drives from the first through the
room between into the second.  ``run`` plays them into a live map, without and with the robot that drives
across, where nothing is stated and where the size of equal rooms is (15 CPU seconds for each seed).  The
robots see rendered images by ORB.

Defends: a robot in the second room is joined only through what a robot saw that drove there; else it is
called ambiguous.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.live.one_process import DENSE
from benchmarks.maps.recordings import track
from client_sdk.frontend import Frame, extract
from client_sdk.simulator import (
    SIMULATED_CAMERA,
    loop_trajectory,
    make_world,
    render_along,
    with_equal_rooms,
)
from client_sdk.tracking.tracker import Tracker
from rse_pf.geometry import Array, inverse
from rse_pf.live_map.events import KeyframeAdded, MapStarted
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.outcomes import Added, Joined, OptimiseWanted
from rse_pf.slam.keyframe import Keyframe, encode_keyframe, make_features

__all__ = ["Drive", "Met", "meet", "prepare_drives"]

ROOMS, EQUAL, APART_M = 5, (1, 3), 10.0
STEP_M = 0.11
WAYS = {"a": (0.6, 3.9), "c": (0.6, 13.9), "b": (10.6, 13.9)}
"""Where on the loop each robot begins and ends: *a* in room 1, *b* in room 3, *c* from one to the other."""
STATED_M = 5.0
_WRONG_M = 1.0
"""A robot that is off by more was joined to the wrong room: equal places are 10 m apart."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """The encoded keyframes of one robot, and their true poses, ``(n, 4, 4)``."""

    keyframes: tuple[bytes, ...]
    T_world_camera: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Met:
    """What became of robot *b* (see `WAYS`).

    ``ever`` and ``wrong_ever`` say whether it was joined at some time, and to a wrong place; ``aligned`` and
    ``wrong`` likewise at the end; ``reason`` why it is not aligned at the end.
    """

    ever: bool
    wrong_ever: bool
    aligned: bool
    wrong: bool
    reason: str


def prepare_drives(folder: Path, seed: int) -> dict[str, Drive]:
    """Return the drives of a seed; they are rendered, tracked and kept if they are not there."""
    path = folder / f"equal-{seed}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        _prepare(path, seed)
    with np.load(path, allow_pickle=False) as held:
        return {
            name: Drive(
                keyframes=tuple(_split(held[f"{name}-keyframes"], held[f"{name}-sizes"])),
                T_world_camera=held[f"{name}-truth"],
            )
            for name in WAYS
        }  # fmt: skip


def meet(drives: dict[str, Drive], names: Sequence[str], stated_m: float) -> Met:
    """Let robots drive at the same time into one live map; the first of *names* begins it."""
    live_map = LiveMap()
    live_map.apply(MapStarted(source="", keyframes=(), equal_rooms_m=stated_m))
    first: dict[str, int] = {}
    ever = wrong_ever = False
    for number in range(max(len(drives[name].keyframes) for name in names)):
        for name in names:
            drive = drives[name]
            if number >= len(drive.keyframes):
                continue
            outcomes = live_map.apply(_event(name, number, drive))
            added = next(outcome.id for outcome in outcomes if isinstance(outcome, Added))
            first.setdefault(name, added)
            outcomes += live_map.apply(live_map.measure(added))
            if any(isinstance(outcome, OptimiseWanted) for outcome in outcomes):
                outcomes += live_map.apply(live_map.optimise())
            joined = any(isinstance(outcome, Joined) and outcome.robot == "b" for outcome in outcomes)
            if "b" in first:
                ever |= joined
                wrong_ever |= joined and _off_m(live_map, drives, names[0], first) > _WRONG_M
    alignment_b = next(alignment for alignment in live_map.alignments() if alignment.robot == "b")
    wrong = alignment_b.aligned and _off_m(live_map, drives, names[0], first) > _WRONG_M
    return Met(
        ever=ever, wrong_ever=wrong_ever, aligned=alignment_b.aligned, wrong=wrong, reason=alignment_b.reason
    )


def _off_m(live_map: LiveMap, drives: dict[str, Drive], root: str, first: dict[str, int]) -> float:
    """Return how far the first keyframe of *b* is from its true place relative to that of *root*."""
    pose = inverse(live_map.pose(first[root])) @ live_map.pose(first["b"])
    true = inverse(drives[root].T_world_camera[0]) @ drives["b"].T_world_camera[0]
    return float(np.linalg.norm(pose[:3, 3] - true[:3, 3]))


def _event(name: str, number: int, drive: Drive) -> KeyframeAdded:
    return KeyframeAdded(robot=name, segment=0, number=number, data=drive.keyframes[number])


def _prepare(path: Path, seed: int) -> None:
    world = with_equal_rooms(make_world(seed, ROOMS), *EQUAL)
    held: dict[str, Array] = {}
    for place, (name, (begin_m, end_m)) in enumerate(WAYS.items()):
        truth = loop_trajectory(begin_m, round((end_m - begin_m) / STEP_M), seed, ROOMS, step_m=STEP_M)
        tracker = Tracker(DENSE)
        keyframes, true = [], []
        for frame, T_world_camera in zip(
            render_along(truth, world, (seed, place)), truth.T_world_camera, strict=True
        ):
            T_odom_camera = track(tracker, frame).T_world_camera
            if T_odom_camera is not None:
                keyframes.append(_encode(frame, T_odom_camera, float(len(keyframes))))
                true.append(T_world_camera)
        held[f"{name}-keyframes"] = np.frombuffer(b"".join(keyframes), dtype=np.uint8)
        held[f"{name}-sizes"] = np.array([len(data) for data in keyframes])
        held[f"{name}-truth"] = np.array(true)
    part = path.with_suffix(".part.npz")
    np.savez(part, **held)
    part.replace(path)


def _encode(frame: Frame, T_odom_camera: Array, timestamp_s: float) -> bytes:
    features = extract(frame, DENSE)
    depths_m = features.points_camera[:, 2]
    rows = np.flatnonzero(np.isfinite(depths_m))[:870]
    keyframe = Keyframe(
        timestamp_s=timestamp_s, T_odom_camera=T_odom_camera, camera=SIMULATED_CAMERA,
        features=make_features(features.pixels[rows], depths_m[rows], features.descriptors[rows]),
    )  # fmt: skip
    return encode_keyframe(keyframe)


def _split(data: Array, sizes: Array) -> list[bytes]:
    ends = np.cumsum(sizes)
    return [data[end - size : end].tobytes() for end, size in zip(ends.tolist(), sizes.tolist(), strict=True)]


@benchmark(Bar("across.*.joined_wrongly", equals=0), Bar("stated.*.joined_wrongly_ever", equals=0))
def run_benchmark(
    *,
    part: Literal["prepare", "run"],
    features: Path = Path("out-equal-rooms"),
    seeds: int = 20,
    processes: int = 2,
) -> dict[str, Any]:
    """Prepare the drives, or tell what became of the robot in the second room."""
    if part == "prepare":
        with get_context("spawn").Pool(processes) as pool:
            pool.starmap(prepare_drives, [(features, seed) for seed in range(seeds)], chunksize=1)
        return {}
    figures: dict[str, Any] = {"across": [], "stated": []}
    for names in (("a", "b"), ("a", "c", "b")):
        for stated_m in (0.0, STATED_M):
            met = [meet(prepare_drives(features, seed), names, stated_m) for seed in range(seeds)]
            row = {
                "robots": "".join(names), "stated_m": stated_m, "n": len(met),
                "joined_ever": sum(meeting.ever for meeting in met),
                "joined_wrongly_ever": sum(meeting.wrong_ever for meeting in met),
                "joined": sum(meeting.aligned for meeting in met),
                "joined_wrongly": sum(meeting.wrong for meeting in met),
                "ambiguous": sum("ambiguous" in meeting.reason for meeting in met),
                "reasons": sorted({meeting.reason for meeting in met}),
            }  # fmt: skip
            say(row)
            figures["stated" if stated_m else "across"].append(row)
    return figures
