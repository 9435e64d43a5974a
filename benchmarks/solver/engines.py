"""Measure the PnP engines, and the cost of the evidence of `solve_pnp` above the bare solver.

Defends: at least 99.5 % right poses at 10-50 % wrong matches with both engines, and with PoseLib at
70 %; thread CPU of `solve_pnp` at most 1.35 times the bare PoseLib call (200 matches, 30 %).
The load average stands beside the figures: discard those of a busy machine.

    python -m benchmarks.solver.engines --out solver.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.errors import RsePfError
from rse_pf.geometry import pose_difference
from rse_pf.pnp import PnpOptions, PnpSolution, available_engines, solve_pnp
from rse_pf.pnp.problems import KINECT, PnpProblem, make_problem

MATCHES = 200
OUTLIER_RATIOS = (0.1, 0.3, 0.5, 0.7)
RIGHT_M, RIGHT_DEG = 0.1, 2.0
MAX_PROBLEMS = 2000
MIN_PAIRS = 500
PACKAGES = {"poselib": "poselib", "opencv": "opencv-python-headless", "native": "rse-pf"}


def cpu_us(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the calling thread's CPU time of *work*, in microseconds, and its result."""
    begin = time.thread_time_ns()
    result = work()
    return (time.thread_time_ns() - begin) / 1e3, result


def solve(problem: PnpProblem, options: PnpOptions) -> PnpSolution | None:
    """Return the solution, or None where there is none."""
    try:
        return solve_pnp(problem.points_world, problem.pixels, problem.camera, options)
    except RsePfError:
        return None


def is_right(problem: PnpProblem, solution: PnpSolution | None) -> bool:
    """Say whether the pose is called ok and lies within 0.1 m and 2 degrees."""
    if solution is None or solution.verdict != "ok":
        return False
    metres, degrees = pose_difference(solution.T_camera_world, problem.T_camera_world)
    return metres < RIGHT_M and degrees < RIGHT_DEG


def measure_engines(problems: int) -> list[dict[str, Any]]:
    """Return one row for each engine and outlier ratio; the engines take turns on each problem."""
    rows = []
    for outlier_ratio in OUTLIER_RATIOS:
        right = dict.fromkeys(available_engines(), 0)
        times: dict[str, list[float]] = {engine: [] for engine in right}
        for seed in range(problems):
            problem = make_problem(seed=seed, n=MATCHES, outlier_ratio=outlier_ratio)
            for engine in right:
                options = PnpOptions(engine=engine)  # type: ignore[arg-type]
                spent, solution = cpu_us(lambda p=problem, o=options: solve(p, o))  # type: ignore[misc]
                times[engine].append(spent)
                right[engine] += is_right(problem, solution)
        for engine, spent_us in times.items():
            p50, p95, p99 = np.percentile(spent_us, [50, 95, 99]).round(1).tolist()
            rows.append(
                {
                    "engine": engine, "outlier_percent": round(100 * outlier_ratio), "n": problems,
                    "right_percent": 100.0 * right[engine] / problems,
                    "cpu_us_p50": p50, "cpu_us_p95": p95, "cpu_us_p99": p99,
                }
            )  # fmt: skip
    return rows


def measure_overhead(pairs: int) -> dict[str, Any]:
    """Return CPU of `solve_pnp` and of the bare PoseLib call, one after the other on ready arrays."""
    import poselib  # measured here against our own use of it

    bare_camera = {
        "model": "PINHOLE", "width": KINECT.width, "height": KINECT.height,
        "params": [KINECT.fx, KINECT.fy, KINECT.cx, KINECT.cy],
    }  # fmt: skip
    ransac = {
        "max_reproj_error": 8.0, "max_error": 8.0, "min_iterations": 10, "max_iterations": 1000,
        "success_prob": 0.999,
    }  # fmt: skip
    problems = [make_problem(seed=seed, n=MATCHES, outlier_ratio=0.3) for seed in range(64)]
    options = PnpOptions(engine="poselib")
    bare: list[float] = []
    ours: list[float] = []
    for i in range(pairs + len(problems)):
        # Not the same problem twice in a row: the second call would find its branches predicted.
        mine, other = problems[i % len(problems)], problems[(i + 32) % len(problems)]

        def call_bare(p: PnpProblem = other) -> Any:
            return poselib.estimate_absolute_pose(p.pixels, p.points_world, bare_camera, ransac, {})

        def call_ours(p: PnpProblem = mine) -> Any:
            return solve_pnp(p.points_world, p.pixels, p.camera, options)

        # The first one pays for cold caches, so they take turns.
        for name in ("bare", "ours") if i % 2 else ("ours", "bare"):
            spent, _ = cpu_us(call_bare if name == "bare" else call_ours)
            if i >= len(problems):
                (bare if name == "bare" else ours).append(spent)
    return {
        "pairs": pairs,
        "bare_us_p50": float(np.median(bare)),
        "solve_pnp_us_p50": float(np.median(ours)),
        "ratio": float(np.median(ours) / np.median(bare)),
    }


def table(report: dict[str, Any]) -> str:
    """Return *report* for a person."""
    lines = [
        f"{'engine':8s} {'wrong %':>7s} {'right %':>8s} {'p50 us':>8s} {'p95 us':>8s} {'p99 us':>8s}     n"
    ]
    for row in report["engines"]:
        lines.append(
            f"{row['engine']:8s} {row['outlier_percent']:7d} {row['right_percent']:8.2f} "
            f"{row['cpu_us_p50']:8.0f} {row['cpu_us_p95']:8.0f} {row['cpu_us_p99']:8.0f} {row['n']:5d}"
        )
    overhead = report["overhead"]
    lines.append(
        f"solve_pnp {overhead['solve_pnp_us_p50']:.0f} us / bare call {overhead['bare_us_p50']:.0f} us = "
        f"{overhead['ratio']:.3f}   ({overhead['pairs']} pairs, thread CPU, 200 matches, 30 % wrong)"
    )
    lines.append(f"load average {report['load_before']} before, {report['load_after']} after")
    return "\n".join(lines)


def main() -> None:
    """Run, print the table, and write ``--out``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--n", type=int, default=200, help=f"problems a cell, at most {MAX_PROBLEMS}")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    arguments = parser.parse_args()
    problems = max(1, min(arguments.n, MAX_PROBLEMS))
    before = [round(load, 2) for load in os.getloadavg()]
    report = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "versions": {engine: version(PACKAGES[engine]) for engine in available_engines()},
        "engines": measure_engines(problems),
        "overhead": measure_overhead(max(MIN_PAIRS, problems)),
        "load_before": before,
        "load_after": [round(load, 2) for load in os.getloadavg()],
    }
    print(table(report))
    if arguments.out:
        arguments.out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
