"""Measure what the depth of both images gives a pose, and what it costs.

Defends: red kitchen at 10 Hz, ATE frame to frame <= 3.4 cm, with loops <= 3.0, merged in three <= 3.3; NYU,
fr1 and redwood no worse than without depth; no lost frame; every command of every codec < 10 kB; mean
normalised error squared near 6; the native core <= 60 us for 200 matches.  CPU figures are of this thread,
native and numpy in turn; the load average stands beside them: discard those of a busy machine.

    python -m benchmarks maps.depth --recordings ../shared/data --out depth.json
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from benchmarks.maps.recordings import judged_answer, truth_of
from benchmarks.maps.services import joined_poses, robots_of
from client_sdk.datasets import Dataset, open_dataset
from client_sdk.frontend import FrontEndOptions, PoseQuery, extract, match
from client_sdk.tracking.tracker import Tracker
from rse_pf.experiments.results.trajectory_error import ate_m
from rse_pf.geometry import Array, inverse, pose_difference
from rse_pf.pnp import PnpOptions, PnpSolution, refine_with_depth, solve_pnp
from rse_pf.pnp.depth_refinement import refine_by_numpy
from rse_pf.pnp.problems import make_two_views
from rse_pf.services.pnp import make_request
from rse_pf.slam.map_merge import merge_versions
from rse_pf.wire import CODECS, Command, make_codec

__all__ = []

_RECORDINGS = {
    "7scenes_redkitchen": FrontEndOptions(),
    "tum_fr1_xyz_start": FrontEndOptions(),
    "redwood_living_room": FrontEndOptions(),
    "nyu_dining_room": FrontEndOptions.wide_baseline(),
}


def recording_row(dataset: Dataset, options: FrontEndOptions, *, with_depth: bool) -> dict[str, float]:
    """Track every frame; return ATE, the error of steps, lost frames and the size of commands."""
    codec, sizes, poses, stamps = make_codec("zlib"), [], [], []
    tracker = Tracker(options)
    for frame in dataset:
        step = tracker.prepare(frame)
        while isinstance(step, PoseQuery):
            sizes.append(_command_bytes(codec, step, with_depth=with_depth))
            pose, inliers, is_weak = judged_answer(step, with_depth=with_depth)
            step = tracker.accept(step, pose, inliers, is_weak=is_weak)
        if step.T_world_camera is not None:
            poses.append(step.T_world_camera)
            stamps.append(frame.timestamp_s)
    truth = truth_of(dataset, stamps)
    steps = [
        pose_difference(inverse(poses[k]) @ poses[k + 1], inverse(truth[k]) @ truth[k + 1])
        for k in range(len(poses) - 1)
    ]
    metres, degrees = np.sqrt(np.square(steps).mean(axis=0))
    return {
        "ate_cm": 100 * ate_m(np.array(poses), truth),
        "step_cm": 100 * metres,
        "step_deg": degrees,
        "lost": tracker.lost_frames,
        "command_bytes_median": float(np.median(sizes)),
        "command_bytes_max": max(sizes),
    }


def _command_bytes(codec: Any, query: PoseQuery, *, with_depth: bool) -> int:
    matches = query.correspondences
    options = PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations)
    request = make_request(
        matches.points_world, matches.pixels, query.camera, options,
        depths_m=matches.depths_m if with_depth else None,
    )  # fmt: skip
    return len(codec.encode(Command(id=1000, service="pnp", payload=request, stream="pose", keep=True)))


def command_rows(dataset: Dataset) -> dict[str, dict[str, int]]:
    """Return the most matches and bytes of a command; long recordings by every tenth step."""
    sizes: dict[str, dict[str, int]] = {}
    step = 1 if len(dataset) < 20 else 10
    for preset, options in (("default", FrontEndOptions()), ("wide", FrontEndOptions.wide_baseline())):
        for row in range(0, len(dataset) - 1, step):
            before, frame = dataset.read(row), dataset.read(row + 1)
            features = extract(before, options), extract(frame, options)
            for codec in CODECS:
                matches = match(*features, options.sent_with(codec))
                request = make_request(
                    matches.points_world, matches.pixels, frame.camera,
                    PnpOptions(inlier_px=options.inlier_px, max_iterations=options.max_iterations),
                    depths_m=matches.depths_m, binary=codec == "bin",
                )  # fmt: skip
                command = Command(id=1000, service="pnp", payload=request, stream="pose", keep=True)
                sent = len(make_codec(codec).encode(command))
                most = sizes.setdefault(f"{preset}, {codec}", {"matches": 0, "bytes": 0})
                most["matches"] = max(most["matches"], len(matches))
                most["bytes"] = max(most["bytes"], sent)
    return sizes


def map_rows(recordings: Path) -> dict[str, float]:
    """Return the red kitchen's errors with loops, and merged in three."""
    alone, three = robots_of(recordings, cuts=((0, 250),)), robots_of(recordings)
    return {
        f"{name}_ate_cm": 100
        * robots.ate_m(joined_poses(robots.runs, merge_versions([run.version for run in robots.runs])))
        for name, robots in (("with_loops", alone), ("merged_in_three", three))
    }


def consistency_row(n: int) -> dict[str, float]:
    """Return the median errors, and the mean normalised error squared, 6 for an honest covariance."""
    errors, squares = [], []
    for seed in range(n):
        views = make_two_views(seed=seed, n=200, outlier_ratio=0.3)
        before = solve_pnp(views.points_reference, views.pixels, views.camera, PnpOptions(inlier_px=5.0))
        after = refine_with_depth(before, views.points_reference, views.pixels, views.depths_m, views.camera)
        both = (before, after)
        errors.append([_error_m(solution, views.T_camera_reference) for solution in both])
        squares.append([_normalised_error2(solution, views.T_camera_reference) for solution in both])
    (before_m, after_m), (before_2, after_2) = np.median(errors, axis=0), np.mean(squares, axis=0)
    return {
        "n": n, "median_mm_pnp": 1e3 * before_m, "median_mm_depth": 1e3 * after_m,
        "normalised_error2_pnp": before_2, "normalised_error2_depth": after_2,
    }  # fmt: skip


def _error_m(solution: PnpSolution, truth: Array) -> float:
    return pose_difference(inverse(solution.T_camera_world), inverse(truth))[0]


def _normalised_error2(solution: PnpSolution, truth: Array) -> float:
    error = truth @ inverse(solution.T_camera_world)
    R = error[:3, :3]
    turned = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    xi = np.concatenate([error[:3, 3], turned])
    return float(xi @ np.linalg.solve(solution.covariance, xi))


def cost_row(n: int) -> dict[str, Any]:
    """Return the thread CPU of the refinement after `solve_pnp`, us, for 200 matches, 30 % wrong."""
    ways: dict[str, Callable[..., PnpSolution]] = {"default": refine_with_depth, "numpy": refine_by_numpy}
    spent: dict[str, list[float]] = {"solve_pnp": [], **{name: [] for name in ways}}
    for seed in range(n):
        views = make_two_views(seed=seed % 100, n=200, outlier_ratio=0.3)
        begin = time.thread_time_ns()
        solution = solve_pnp(views.points_reference, views.pixels, views.camera, PnpOptions(inlier_px=5.0))
        spent["solve_pnp"].append((time.thread_time_ns() - begin) / 1e3)
        for name, refine in ways.items():
            begin = time.thread_time_ns()
            refine(solution, views.points_reference, views.pixels, views.depths_m, views.camera)
            spent[name].append((time.thread_time_ns() - begin) / 1e3)
    return {
        **{name: spread(times) for name, times in spent.items()},
    }


@benchmark(
    Bar("cost_us.default.p50", at_most=60.0, unit="us of CPU"),
    Bar("7scenes_redkitchen.depth.ate_cm", at_most=3.4, unit="cm"),
    Bar("red_kitchen_maps.with_loops_ate_cm", at_most=3.0, unit="cm"),
    Bar("red_kitchen_maps.merged_in_three_ate_cm", at_most=3.3, unit="cm"),
    Bar("*.depth.lost", equals=0),
    Bar("*.depth.command_bytes_max", at_most=10_000, unit="bytes"),
    Bar("worse_than_pnp_cm.*", at_most=0.0, unit="cm"),
)
def run_benchmark(
    *,
    recordings: Annotated[Path | None, "folder of recordings; without it they are left out"] = None,
    n: int = 1000,
) -> dict[str, Any]:
    """Measure the refinement alone, and on recordings where there are some."""
    figures: dict[str, Any] = {"cost_us": cost_row(max(500, n // 2)), "consistency": consistency_row(n)}
    if recordings is not None:
        for name, options in _RECORDINGS.items():
            dataset = open_dataset(recordings / name)
            figures[name] = {
                label: recording_row(dataset, options, with_depth=with_depth)
                for label, with_depth in (("pnp", False), ("depth", True))
            }
            figures[name]["commands"] = command_rows(dataset)
        figures["red_kitchen_maps"] = map_rows(recordings)
        figures["worse_than_pnp_cm"] = {
            name: figures[name]["depth"]["ate_cm"] - figures[name]["pnp"]["ate_cm"] for name in _RECORDINGS
        }
    return figures
