"""Ten robots in one live map of ten rendered rooms, on two cores, and their poses without a live map.

    python -m benchmarks live.many prepare [--features DIR] [--robots 10] [--rooms 10] [--frames 200]
    python -m benchmarks live.many run [--features DIR] [--rounds 1]

``prepare`` renders the drives and keeps the features of each frame (12 CPU minutes for ten rooms, 190 MB).
Each robot drives 3.5 m beyond the start of the next robot: with the least overlap, robots met only in their
last frames.  ``run`` starts a process for each robot, which sends its frames at 5 Hz to a local platform with
two servers, alternately without and with a live map.  Matching, poses, keyframes and corrections are real;
only the extraction of features and the robots' own point clouds are left out, which run on other computers in
the field.

Defends the promise of live maps of several robots: all robots are joined in one map, the p99 of the delay of
corrections is <= 1 s, and the p99 of poses is <= 1.3 times the p99 without a live map.
"""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

import rse_pf.extensions.experiments.demo.robot as demo_robot
import rse_pf.extensions.experiments.demo.run as demo_run
from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import percentile
from client_sdk import frontend, point_map
from client_sdk.datasets import Dataset
from client_sdk.frontend import Features, Frame, FrontEndOptions
from client_sdk.simulator import SIMULATED_CAMERA, render_frames, true_trajectory
from client_sdk.tracking import tracker
from client_sdk.trajectory import Trajectory
from rse_pf.config import PlatformSettings
from rse_pf.extensions.experiments.demo.run import DemoOptions, RobotSpec, run_demo
from rse_pf.extensions.experiments.results.records import read_commands

SEED = 0  # seed of the rendered world and drives
RATE_HZ = 5.0  # frames per second of each robot
MAX_CORRECTION_P99_MS = 1000.0  # largest p99 of the delay from a keyframe to the correction that it causes
MAX_POSES_P99_RATIO = 1.3  # largest ratio of the p99 of poses with a live map to that without one
_FEATURES = "RSE_PF_BENCHMARK_FEATURES"  # environment variable that names the folder of features to robots
_ABOUT = "about.json"  # file with the numbers of robots, rooms and frames of the prepared features
# Options of the trackers; features are rounded as the codec zlib sends them.
_OPTIONS = FrontEndOptions().sent_with("zlib")
# Fields of `Features` that are stored.
_ARRAYS = ("pixels", "descriptors", "points_camera", "orientations", "sizes", "distinctiveness")


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The arguments: ``prepare`` writes the folder *features*, and ``run`` reads it.

    *robots* to *processes* are for ``prepare``; *frames* are those of each robot.  *rounds* and *folder* are
    for ``run``.
    """

    part: Literal["prepare", "run"]
    features: Path = Path("out-live-features")
    robots: int = 10
    rooms: int = 10
    frames: int = 200
    processes: int = 2
    rounds: int = 1
    folder: Annotated[Path, "folder of the records"] = Path("out-live-many")


def prepare(folder: Path, robots: int, rooms: int, frames: int, processes: int = 2) -> None:
    """Render the drive of each robot, of *frames* frames, and write the features of its frames.

    A robot whose file exists is left out, whatever numbers it was made for: use a new *folder* for others.
    """
    folder.mkdir(parents=True, exist_ok=True)
    orders = [
        (folder, robot, robots, rooms, frames)
        for robot in range(robots)
        if not _file_of(folder, robot).exists()
    ]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        pool.starmap(_prepare_robot, orders, chunksize=1)
    about = {"robots": robots, "rooms": rooms, "frames": frames, "seed": SEED}
    (folder / _ABOUT).write_text(json.dumps(about) + "\n", encoding="utf-8")


def run(folder: Path, out: Path, rounds: int) -> dict[str, Any]:
    """Run the robots alternately without and with a live map; return the figures of all rounds."""
    about = json.loads((folder / _ABOUT).read_text(encoding="utf-8"))
    os.environ[_FEATURES] = str(folder.resolve())
    demo_run.run_robot = run_feature_robot
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for turn in range(rounds):
        options = DemoOptions(
            robots=about["robots"], rate_hz=RATE_HZ, frames=about["frames"], seed=SEED, quiet=True,
            out=out / f"alone-{turn}",
        )  # fmt: skip
        run_demo(options, PlatformSettings())
        alone = _poses_ms(options.out)
        options = replace(options, out=out / f"live-{turn}", live=True)
        run_demo(options, PlatformSettings())
        concurrent = _poses_ms(options.out)
        live = json.loads((options.out / "report.json").read_text(encoding="utf-8"))["live"]
        rows.append(
            {
                "joined": live["joined"],
                "not_joined": about["robots"] - live["joined"],
                "join_frame": live["join_frame"],
                "aligned_percent": live["aligned_percent"],
                "final_ate_cm": live["final_ate_cm"],
                "keyframes": live["keyframes"],
                "keyframes_waiting": live["keyframes_waiting"],
                "lost_frames": live["lost_frames"],
                "correction_ms": live["correction_ms"],
                "keyframe_kept_ms": live["keyframe_kept_ms"],
                "poses_p99_ms": {
                    "alone": percentile(alone, 99),
                    "with_live_map": percentile(concurrent, 99),
                    "n": len(concurrent),
                },
                "poses_p99_ratio": round(percentile(concurrent, 99) / percentile(alone, 99), 3),
            }
        )
    return {**about, "rounds": rows}


def run_feature_robot(spec: RobotSpec, pipe: Connection) -> None:
    """Run a robot of the demo on frames whose features were computed beforehand; entry point of a process."""
    recording, features = _read(Path(os.environ[_FEATURES]), spec.number)
    tracker.extract = lambda frame, options, plugin=None: features[frame.timestamp_s]
    point_map.PointMap.add = lambda *_: 0
    demo_robot._load = lambda *_: recording
    demo_robot.run_robot(spec, pipe)


def _prepare_robot(folder: Path, robot: int, robots: int, rooms: int, frames: int) -> None:
    features = [
        frontend.extract(frame, _OPTIONS) for frame in render_frames(robot, robots, frames, SEED, rooms)
    ]
    truth = true_trajectory(robot, robots, frames, SEED, rooms)
    part = _file_of(folder, robot).with_suffix(".part.npz")
    np.savez(
        part,
        counts=[len(row.pixels) for row in features],
        **{name: np.concatenate([getattr(row, name) for row in features]) for name in _ARRAYS},
        stamps=truth.timestamps_s,
        poses=truth.T_world_camera,
    )
    part.replace(_file_of(folder, robot))


def _read(folder: Path, robot: int) -> tuple[Dataset, dict[float, Features]]:
    """Return a recording whose frames have no image, and the features of each frame by its time stamp."""
    with np.load(_file_of(folder, robot)) as file:
        held = {name: file[name] for name in file.files}
    rgb = np.zeros((SIMULATED_CAMERA.height, SIMULATED_CAMERA.width, 3), dtype=np.uint8)
    depth_m = np.ones((SIMULATED_CAMERA.height, SIMULATED_CAMERA.width), dtype=np.float32)
    stamps = [float(stamp) for stamp in held["stamps"]]
    frames = [Frame(timestamp_s=stamp, rgb=rgb, depth_m=depth_m, camera=SIMULATED_CAMERA) for stamp in stamps]
    recording = Dataset(
        name="rendered",
        camera=SIMULATED_CAMERA,
        timestamps_s=tuple(stamps),
        truth=Trajectory(held["stamps"], held["poses"]),
        truth_kind="ground truth",
        rows=tuple(range(len(frames))),
        read=frames.__getitem__,
    )
    return recording, dict(zip(stamps, _split(held), strict=True))


def _split(held: dict[str, Any]) -> Iterator[Features]:
    at = 0
    for count in held["counts"].tolist():
        rows = slice(at, at + count)
        at += count
        yield Features(**{name: held[name][rows] for name in _ARRAYS})


def _file_of(folder: Path, robot: int) -> Path:
    return folder / f"robot-{robot + 1}.npz"


def _poses_ms(out: Path) -> list[float]:
    commands = read_commands(out / "commands.csv")
    return [command.round_trip_ms for command in commands if command.round_trip_ms is not None]


@benchmark(
    Bar("rounds.*.not_joined", at_most=0),
    Bar("rounds.*.correction_ms.p99", at_most=MAX_CORRECTION_P99_MS, unit="ms"),
    Bar("rounds.*.poses_p99_ratio", at_most=MAX_POSES_P99_RATIO, unit="times"),
)
def run_benchmark(chosen: Options) -> dict[str, Any]:
    """Prepare the features, or run the robots."""
    if chosen.part == "prepare":
        prepare(chosen.features, chosen.robots, chosen.rooms, chosen.frames, chosen.processes)
        return {}
    return run(chosen.features, chosen.folder, chosen.rounds)
