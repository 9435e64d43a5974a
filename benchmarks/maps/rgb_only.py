"""Measure maps of a camera without depth: trajectory error with and without a scale, lost frames, cuts, time.

Defends, after a similarity alignment (Sim(3)) of all poses, with the truth interpolated to the frames:

- red kitchen at 10 Hz without its depth: 0 lost after the start, <= 4.5 cm; with the scale of the first metre
  of odometry (the true poses of that metre stand for odometry): ATE <= 8 cm
- MH_01's part, left camera at 20 Hz: 0 lost after the start, <= 0.5 cm
- KITTI 00's part, left camera: >= 95 % of the frames posed, <= 1.5 % of the path
- a video with a cut: a second segment begins within 2 s, and is joined where it overlaps, nowhere else; after
  a covered lens, or a pause in a mapped place, the map goes on within 1 s

Poses are solved in this process as the service does.  Everything but time is deterministic: n = 1, and load
changes no other figure.  CPU figures are of all threads of the process; the load average stands beside them.

"ATE" is of the poses that are saved, after an adjustment of all keyframes, "live ATE" of each metric pose at
the moment when the robot got it.  With --hold-out, drives that did not choose the thresholds are measured,
too, without a bar: rendered worlds of four seeds, TUM fr1, other frames of the kitchen, and MH_01 at
10 Hz.

    python -m benchmarks maps.rgb_only --recordings ../shared/data --out rgb_only.json
    python -m benchmarks maps.rgb_only --recordings ../shared/data --hold-out
"""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, Recordings, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from benchmarks.maps.recordings import track
from client_sdk.answers import PoseAnswer
from client_sdk.datasets import Dataset, open_dataset
from client_sdk.datasets.rig_recordings import open_euroc, open_kitti
from client_sdk.frontend import Frame, PoseQuery
from client_sdk.mapper import Mapper
from client_sdk.mapping import Trajectory
from client_sdk.monocular.scale import OdometryScale
from client_sdk.simulator import render_frames, true_trajectory
from client_sdk.tracking.monocular_tracker import MonocularTracker
from rse_pf.experiments.results.trajectory_error import absolute_error
from rse_pf.pnp import PnpOptions, solve_pnp
from rse_pf.services.pnp import make_request
from rse_pf.wire import Command, make_codec

__all__ = []

_RECORDING = "7scenes_redkitchen"
_MAX_ATE_CM, _MAX_LOST_PERCENT = 8.0, 5.0
_KITTI, _EUROC = "kitti_00_left_start", "euroc_mh01_start"
_MAX_KITCHEN_CM, _MAX_EUROC_CM = 4.5, 0.5
_MIN_KITTI_POSED, _MAX_KITTI_PERCENT = 0.95, 1.5
_MAX_AFTER_CUT_S, _MAX_RELOCALISE_S = 2.0, 1.0
_WORLD_FRAMES = 80
_MIN_POSES = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """Frames of one camera, and its true path."""

    name: str
    frames: Iterable[Frame]
    count: int
    truth: Trajectory


def load_drive(dataset: Dataset, name: str) -> Drive:
    """Return the drive of a recording."""
    assert dataset.truth is not None
    return Drive(name=name, frames=dataset, count=len(dataset), truth=dataset.truth)


def _world(seed: int) -> Drive:
    return Drive(
        name=f"rendered world, seed {seed}",
        frames=render_frames(0, 1, _WORLD_FRAMES, seed),
        count=_WORLD_FRAMES,
        truth=true_trajectory(0, 1, _WORLD_FRAMES, seed),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cut:
    """A video with a cut: its frames, their true poses, and what must come of it.

    Attributes:
        name: Of the row.
        frames: In the order of time, without depth.
        truth: One pose for each frame; each place has a frame of its own.
        seen_s: When a place, known or new, is seen again after the cut.
        within_s: The first pose comes so soon after it.
        segments: At the end.
    """

    name: str
    frames: list[Frame]
    truth: Trajectory
    seen_s: float
    within_s: float
    segments: int


def cuts(recordings: Path) -> Iterator[Cut]:
    """Yield videos that were cut, covered or continued elsewhere."""
    kitchen = load_drive(open_dataset(recordings / _RECORDING), "kitchen")
    worlds = [_world(seed) for seed in range(2)]
    of_kitchen = list(kitchen.frames)
    new, known = _MAX_AFTER_CUT_S, _MAX_RELOCALISE_S
    one, other = list(worlds[0].frames), list(worlds[1].frames)
    dark = [replace(frame, rgb=np.zeros_like(frame.rgb)) for frame in of_kitchen[100:130]]
    whole = (kitchen, of_kitchen)
    first, second = (worlds[0], one), (worlds[1], other)
    parts: list[tuple[str, list[tuple[Drive, list[Frame]]], int, float, int]] = [
        ("the kitchen's end, then all of it", [(kitchen, of_kitchen[170:]), whole], 80, new, 1),
        (
            "5 s of the kitchen cut out",
            [(kitchen, of_kitchen[:100]), (kitchen, of_kitchen[150:])],
            100, known, 1,
        ),
        (
            "the lens covered for 3 s",
            [(kitchen, of_kitchen[:100]), (kitchen, dark), (kitchen, of_kitchen[101:])],
            130, known, 1,
        ),
        (
            "two halves of the kitchen that overlap",
            [(kitchen, of_kitchen[:140:2]), (kitchen, of_kitchen[61::2])],
            70, known, 1,
        ),
        ("two rendered worlds", [first, second], 80, new, 2),
        ("two rendered worlds, and back", [first, second, first], 160, known, 2),
    ]  # fmt: skip
    for name, shown, cut, within_s, segments in parts:
        poses = [drive.truth.at([frame.timestamp_s for frame in frames]) for drive, frames in shown]
        frames = [frame for _, some in shown for frame in some]
        stamps_s = np.arange(len(frames)) / 10
        yield Cut(
            name=name,
            frames=[
                replace(frame, timestamp_s=float(stamp_s), depth_m=np.zeros_like(frame.depth_m))
                for frame, stamp_s in zip(frames, stamps_s, strict=True)
            ],
            truth=Trajectory(stamps_s, np.concatenate(poses)),
            seen_s=float(stamps_s[cut]), within_s=within_s, segments=segments,
        )  # fmt: skip


def cut_row(cut: Cut) -> dict[str, Any]:
    """Track a video with a cut; return its segments, their errors, and how soon it went on."""
    tracker = MonocularTracker()
    first_s = np.inf
    for frame in cut.frames:
        step = track(tracker, frame)
        if step.T_world_camera is not None and frame.timestamp_s >= cut.seen_s:
            first_s = min(first_s, frame.timestamp_s)
    tracker.adjust()
    errors_cm = []
    for segment in tracker.segments:
        path = tracker.trajectory(segment)
        errors_cm.append(100 * absolute_error(path, cut.truth, with_scale=True).rmse_m)
    return {
        "frames": len(cut.frames),
        "lost": tracker.lost_frames,
        "segments": len(tracker.segments),
        "joins": len(tracker.joins),
        "join_scales": [join.scale for join in tracker.joins],
        "loops": tracker.loops,
        "after_s": first_s - cut.seen_s,
        "sim3_cm": errors_cm,
    }


def held_out_drives(recordings: Path) -> Iterator[Drive]:
    """Yield drives that did not choose the thresholds of the tracker."""
    yield from (_world(seed) for seed in range(4))
    yield load_drive(open_dataset(recordings / "tum_fr1_xyz_start"), "fr1 (start)")
    kitchen = open_dataset(recordings / _RECORDING)
    for first, stride in ((1, 2), (0, 3)):
        chosen = replace(
            kitchen, rows=kitchen.rows[first::stride], timestamps_s=kitchen.timestamps_s[first::stride]
        )
        yield load_drive(chosen, f"kitchen, {10 / stride:.3g} Hz from frame {first}")
    yield load_drive(open_euroc(recordings / _EUROC, camera="left", imu=False).thinned(10.0), "MH_01, 10 Hz")


def row_of(drive: Drive, *, with_scale: bool) -> dict[str, Any]:
    """Map a drive without its depth; return errors, lost frames, time and the size of commands."""
    truth = drive.truth
    codecs = {name: make_codec(name) for name in ("json", "zlib", "bin")}
    sizes: dict[str, list[int]] = {name: [] for name in codecs}

    async def ask(query: PoseQuery) -> PoseAnswer:
        matches = query.correspondences
        options = PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations)
        for name, codec in codecs.items():
            request = make_request(
                matches.points_world, matches.pixels, query.camera, options, binary=name == "bin"
            )
            sizes[name].append(len(codec.encode(Command(id=1, service="pnp", payload=request))))
        solution = solve_pnp(matches.points_world, matches.pixels, query.camera, options)
        return PoseAnswer(
            solution=solution, source="robot", server="", round_trip_ms=0.0, queue_ms=0.0, compute_ms=0.0
        )

    scale = OdometryScale(truth.timestamps_s, truth.positions) if with_scale else None
    mapper = Mapper(ask=ask, depth=False, scale=scale)
    live: list[tuple[float, Any]] = []
    frame_ms: list[float] = []

    async def track() -> None:
        for frame in drive.frames:
            frame = replace(frame, depth_m=np.zeros_like(frame.depth_m))
            began = time.process_time()
            done = await mapper.track(frame)
            frame_ms.append(1e3 * (time.process_time() - began))
            if done.T_world_camera is not None and done.scale == ("metric" if with_scale else "up to scale"):
                live.append((frame.timestamp_s, done.T_world_camera))

    asyncio.run(track())
    tracked = mapper.trajectory
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        report = mapper.save(Path(folder))
        save_s = time.process_time() - began
    adjusted = mapper.trajectory
    row = {
        "frames": drive.count,
        "poses": len(adjusted),
        "lost": mapper.lost_frames,
        "before_start": report["frames_before_start"],
        "segments_apart": report["segments_apart"],
        "live_metric_poses": len(live) if with_scale else None,
        "keyframes": mapper.keyframes,
        "landmarks": report["map_points"],
        "scale": mapper.scale,
        "path_m": truth.length_m,
        "cpu_ms": spread(frame_ms),
        "command_bytes_max": {name: max(size, default=0) for name, size in sizes.items()},
        "ate_cm": None,
        "live_ate_cm": None,
        "sim3_cm": None,
        "sim3_before_save_cm": None,
        "save_s": save_s,
        "sim3_scale": None,
    }
    if len(adjusted) >= _MIN_POSES:
        at_frames = Trajectory(adjusted.timestamps_s, truth.at(adjusted.timestamps_s))
        similar = absolute_error(adjusted, at_frames, with_scale=True)
        before = absolute_error(tracked, at_frames, with_scale=True)
        row |= {"sim3_cm": 100 * similar.rmse_m, "sim3_scale": similar.scale}
        row |= {"sim3_before_save_cm": 100 * before.rmse_m}
    if len(live) >= _MIN_POSES and mapper.scale.startswith("metric"):
        as_it_came = Trajectory(np.array([stamp for stamp, _ in live]), np.array([pose for _, pose in live]))
        row["ate_cm"] = 100 * absolute_error(adjusted, truth).rmse_m
        row["live_ate_cm"] = 100 * absolute_error(as_it_came, truth).rmse_m
    return row


@benchmark(
    Bar("metric.*.ate_cm", at_most=_MAX_ATE_CM, unit="cm"),
    Bar("metric.*.lost_percent", at_most=_MAX_LOST_PERCENT, unit="%"),
    Bar("kitchen.*.sim3_cm", at_most=_MAX_KITCHEN_CM, unit="cm"),
    Bar("kitchen.*.lost", equals=0),
    Bar("MH_01.sim3_cm", at_most=_MAX_EUROC_CM, unit="cm"),
    Bar("MH_01.lost", equals=0),
    Bar("KITTI 00.posed_percent", at_least=100 * _MIN_KITTI_POSED, unit="%"),
    Bar("KITTI 00.sim3_percent_of_path", at_most=_MAX_KITTI_PERCENT, unit="%"),
    Bar("cuts.*.segments_beyond", equals=0),
    Bar("cuts.*.late_s", at_most=0.0, unit="s"),
)
def run_benchmark(
    *,
    recordings: Recordings = Path("../shared/data"),
    rates: tuple[float, ...] = (10.0,),
    hold_out: Annotated[bool, "also measure other drives, without a bar"] = False,
) -> dict[str, Any]:
    """Map the drives without their depth."""
    figures: dict[str, Any] = {"metric": {}, "kitchen": {}, "cuts": {}, "held_out": {}}

    def measure(drive: Drive, *, with_scale: bool) -> dict[str, Any]:
        row = row_of(drive, with_scale=with_scale)
        row["lost_percent"] = 100 * row["lost"] / row["frames"]
        row["posed_percent"] = 100 * row["poses"] / row["frames"]
        if row["sim3_cm"] is not None:
            row["sim3_percent_of_path"] = row["sim3_cm"] / row["path_m"]
        say({"drive": drive.name, "with_scale": with_scale, **row})
        return row

    for rate_hz in rates:
        dataset = open_dataset(recordings / _RECORDING).thinned(rate_hz)
        for part, with_scale in (("metric", True), ("kitchen", False)):
            drive = load_drive(dataset, f"kitchen, {rate_hz:g} Hz")
            figures[part][f"{rate_hz:g} Hz"] = measure(drive, with_scale=with_scale)
    euroc = open_euroc(recordings / _EUROC, camera="left", imu=False)
    figures["MH_01"] = measure(load_drive(euroc, "MH_01, 20 Hz"), with_scale=False)
    figures["KITTI 00"] = measure(load_drive(open_kitti(recordings / _KITTI), "KITTI 00"), with_scale=False)
    for cut in cuts(recordings):
        row = cut_row(cut)
        row |= {"segments_beyond": row["segments"] - cut.segments, "late_s": row["after_s"] - cut.within_s}
        figures["cuts"][cut.name] = row
        say({"cut": cut.name, **row})
    if hold_out:
        for drive in held_out_drives(recordings):
            figures["held_out"][drive.name] = measure(drive, with_scale=True)
    return figures
