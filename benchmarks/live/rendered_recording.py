"""Write the drives of the rendered world as a recording in TUM layout, once for many runs.

Rendering takes a third of a second for each frame, more than a robot has; benchmarks that need minutes of
driving play this recording with ``--data`` instead.  The frames of robot 0 come first, then those of robot 1,
so that `Dataset.share` gives each robot its own drive.  Depth is kept to 0.2 mm; the images are not
compressed (1.5 MB a frame), so that reading them takes no time from the robots.

    python -m benchmarks live.rendered_recording FOLDER [--robots 3] [--frames 300] [--seed 0] [--processes 2]
"""

from __future__ import annotations

import multiprocessing
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.frame.registry import benchmark
from client_sdk.mapping import Trajectory, write_trajectory
from client_sdk.rigs.intrinsics import Intrinsics, write_intrinsics
from client_sdk.simulator import RATE_HZ, SIMULATED_CAMERA, render_frames, true_trajectory

__all__ = ["write_recording"]

DEPTH_SCALE = 5000.0


def write_recording(folder: Path, robots: int, frames: int, seed: int, processes: int = 2) -> Path:
    """Write the recording unless *folder* has it already; return *folder*."""
    done = folder / f"{robots}-robots-{frames}-frames-seed-{seed}"
    if done.exists():
        return folder
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    orders = [(folder, robot, robots, frames, seed) for robot in range(robots)]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        pool.starmap(_write_robot, orders, chunksize=1)
    truths = [true_trajectory(robot, robots, frames, seed) for robot in range(robots)]
    stamps = np.concatenate([_stamps(robot, frames) for robot in range(robots)])
    poses = np.concatenate([truth.T_world_camera for truth in truths])
    write_trajectory(folder / "groundtruth.txt", Trajectory(stamps, poses))
    write_intrinsics(folder / "intrinsics.json", Intrinsics(camera=SIMULATED_CAMERA, depth_scale=DEPTH_SCALE))
    for name, suffix in (("rgb", "ppm"), ("depth", "pgm")):
        lines = [f"{stamp:.6f} {name}/{stamp:.6f}.{suffix}\n" for stamp in stamps]
        (folder / f"{name}.txt").write_text("".join(lines), encoding="utf-8")
    done.touch()
    return folder


def _stamps(robot: int, frames: int) -> np.ndarray:
    return (robot * frames + np.arange(frames)) / RATE_HZ


def _write_robot(folder: Path, robot: int, robots: int, frames: int, seed: int) -> None:
    import cv2

    stamps = _stamps(robot, frames)
    for row, frame in enumerate(render_frames(robot, robots, frames, seed)):
        name = f"{stamps[row]:.6f}"
        depth = np.round(frame.depth_m * DEPTH_SCALE).astype(np.uint16)
        cv2.imwrite(str(folder / "rgb" / f"{name}.ppm"), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
        cv2.imwrite(str(folder / "depth" / f"{name}.pgm"), depth)


@benchmark()
def run_benchmark(
    *, folder: Path, robots: int = 3, frames: int = 300, seed: int = 0, processes: int = 2
) -> dict[str, Any]:
    """Write one recording."""
    return {"folder": write_recording(folder, robots, frames, seed, processes)}
