"""Measure the native solver against PoseLib as version 0.1.0 used it: CPU, success, accuracy, verdicts.

Defends, with all evidence in the native figures and none in PoseLib's: at least 6 times less CPU at 200
matches and 30, 50 and 70 % wrong ones; success at most 0.05 percentage points lower overall and 0.5 at each
outlier ratio; median error within 2 % and p95 within 5 %; no pose that is wrong and called ok; as many right
poses called ok; mean normalised error squared 6 +- 0.6; the same bytes with and without AVX2.
The load average stands beside the figures: discard CPU figures of a busy machine.

    python -m benchmarks solver.native --n 10000 --out native.json
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from rse_pf import native
from rse_pf.errors import RsePfError
from rse_pf.geometry import Array, Camera, exp_se3, inverse, pose_difference, transform
from rse_pf.pnp import PnpOptions, WeakLimits, engines, solve_pnp
from rse_pf.pnp.problems import DEGENERATE, KINECT, make_degenerate, make_problem

RIGHT_M, RIGHT_DEG = 0.1, 2.0
KINDS = ("room", "room", "room", "room", "plane", "near-line", "few", "few")
RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "data"
OPTIONS, LIMITS = PnpOptions(), WeakLimits()
OLD, PYTHON = "poselib of 0.1.0", "native pose, Python evidence"


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One problem; ``T_camera_world`` is None where the truth is not known."""

    kind: str
    points_world: Array
    pixels: Array
    T_camera_world: Array | None
    camera: Camera = KINECT


def case(number: int) -> Case:
    """Return one of endlessly many problems of all kinds; equal numbers give equal problems."""
    kind, seed = KINDS[number % len(KINDS)], number // len(KINDS)
    rng = np.random.default_rng(number)
    if kind == "room":
        seed = 4 * seed + number % len(KINDS)
        tenths = 1 + seed % 8
        problem = make_problem(
            seed=number, n=(30, 60, 100, 200, 300)[seed // 8 % 5], outlier_ratio=tenths / 10,
            depth_noise=seed // 40 % 2 == 1,
        )  # fmt: skip
        return Case(f"room {10 * tenths} %", problem.points_world, problem.pixels, problem.T_camera_world)
    if kind == "few":
        problem = make_problem(
            seed=number, n=4 + seed % 13, outlier_ratio=(0.0, 0.2, 0.4)[seed // 13 % 3],
            noise_px=(0.5, 1.0, 2.0)[seed // 39 % 3],
        )  # fmt: skip
        return Case(kind, problem.points_world, problem.pixels, problem.T_camera_world)
    if kind == "near-line":
        direction = rng.normal(size=3)
        points = np.linspace(-0.5, 0.5, 100)[:, None] * direction * rng.uniform(0.3, 3.0)
        points += rng.normal(size=(100, 3)) * rng.choice([0.001, 0.01, 0.05, 0.1, 0.2])
    else:
        size_m = rng.uniform(0.2, 3.0)
        points = np.column_stack([rng.uniform(-size_m / 2, size_m / 2, (100, 2)), np.zeros(100)])
    T = exp_se3([*rng.uniform(-0.3, 0.3, 2), rng.uniform(2.0, 6.0), *rng.normal(size=3) * 0.4])
    points = points[transform(T, points)[:, 2] > 0.5]
    pixels = KINECT.project(transform(T, points)) + rng.normal(size=(len(points), 2)) * rng.uniform(0.3, 2.0)
    wrong = int(rng.choice([0.0, 0.2, 0.5]) * len(points))
    pixels[:wrong] = rng.uniform(0, [KINECT.width, KINECT.height], (wrong, 2))
    return Case(kind, points, pixels, T)


def degenerate(number: int) -> Case:
    """Return correspondences that fix no pose."""
    kind = DEGENERATE[number % len(DEGENERATE)]
    problem = make_degenerate(kind, seed=number // len(DEGENERATE), n=(20, 100)[number % 2])
    return Case(kind, problem.points_world, problem.pixels, None)


def recorded_cases(folder: Path) -> Iterator[Case]:
    """Yield the matches of each frame with the one before; the truth where the recording has it."""
    from client_sdk.datasets import open_dataset
    from client_sdk.frontend import FrontEndOptions, extract, match

    options = FrontEndOptions()
    for recording in sorted(path for path in folder.iterdir() if (path / "rgb.txt").exists()):
        dataset, before, before_row = open_dataset(recording), None, 0
        truth = dataset.truth if dataset.truth_kind == "ground truth" else None
        for row in range(len(dataset)):
            frame = dataset.read(row)
            features = extract(frame, options)
            if before is not None:
                matches = match(before, features, options)
                if len(matches) >= 4:
                    T = None
                    if truth is not None:
                        T = inverse(truth.T_world_camera[row]) @ truth.T_world_camera[before_row]
                    yield Case(recording.name, matches.points_world, matches.pixels, T, frame.camera)
            before, before_row = features, row


def old_engine() -> engines.Engine:
    """Return PoseLib with the settings of version 0.1.0: three times the trials."""
    import poselib  # the reference of this comparison

    def solve(points_world: Array, pixels: Array, camera: Camera, options: PnpOptions) -> Array | None:
        model = {
            "model": "PINHOLE", "width": camera.width, "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy],
        }  # fmt: skip
        ransac = {
            "max_reproj_error": options.inlier_px, "max_iterations": options.max_iterations,
            "min_iterations": min(options.min_iterations, options.max_iterations),
            "success_prob": options.confidence,
        }  # fmt: skip
        pose: Array = poselib.estimate_absolute_pose(pixels, points_world, model, ransac, {})[0].Rt
        return pose

    return solve


@contextlib.contextmanager
def references() -> Iterator[None]:
    """Let `solve_pnp` know PoseLib as 0.1.0 used it, and the native pose with the Python evidence."""
    engines.ENGINES[OLD] = old_engine
    engines.ENGINES[PYTHON] = engines.ENGINES["native"]
    try:
        yield
    finally:
        del engines.ENGINES[OLD], engines.ENGINES[PYTHON]


def cpu_us(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the calling thread's CPU time of *work*, in microseconds, and its result."""
    begin = time.thread_time_ns()
    result = work()
    return (time.thread_time_ns() - begin) / 1e3, result


def measure_cpu(problems: int) -> list[dict[str, Any]]:
    """Return CPU of the bare PoseLib call and of the native solver with its evidence, taking turns."""
    solver, limits = native.native_solver(), engines.native_options(OPTIONS, LIMITS)
    narrow, bare = msgspec.structs.replace(limits, lanes="portable"), old_engine()
    rows = []
    for n, percent in ((200, 10), (200, 30), (200, 50), (200, 70), (100, 70), (500, 30), (2000, 70)):
        times: dict[str, list[float]] = {"poselib": [], "native": [], "portable": []}
        for seed in range(problems if n <= 500 else problems // 5):
            p = make_problem(seed=seed, n=n, outlier_ratio=percent / 100)
            work = {
                "poselib": lambda p=p: bare(p.points_world, p.pixels, KINECT, OPTIONS),
                "native": lambda p=p: solver.solve(p.points_world, p.pixels, KINECT, limits),
                "portable": lambda p=p: solver.solve(p.points_world, p.pixels, KINECT, narrow),
            }
            # The first one pays for cold caches, so they take turns.
            for name in sorted(work, reverse=seed % 2 == 1):
                spent, _ = cpu_us(work[name])
                times[name].append(spent)
        p50 = {f"{name}_us_p50": float(np.median(spent)) for name, spent in times.items()}
        ratio = p50["poselib_us_p50"] / p50["native_us_p50"]
        rows.append(
            {"matches": n, "outlier_percent": percent, "n": len(times["native"]), **p50, "ratio": ratio}
        )
    return rows


def outcome(work: Callable[[], Any]) -> tuple[str, str, Any]:
    """Return the verdict or the error's name, its text, and the solution."""
    try:
        solution = work()
    except RsePfError as error:
        return type(error).__name__, f"{error.message}; {error.hint}", None
    return (f"weak: {solution.reason}" if solution.reason else "ok"), "", solution


def same_bytes(one: native.Evidence | None, other: native.Evidence | None) -> bool:
    """Say whether two results of the library are equal to the last bit."""
    if one is None or other is None:
        return one is other
    return all(
        np.asarray(getattr(one, name)).tobytes() == np.asarray(getattr(other, name)).tobytes()
        for name in native.Evidence.__struct_fields__
        if name != "reason"
    )


def judgements(each: Case) -> tuple[tuple[str, str, Any], ...]:
    """Return the outcomes of PoseLib, of the library, of it without AVX2, and with the Python evidence."""
    solver, limits = native.native_solver(), engines.native_options(OPTIONS, LIMITS)
    narrow = msgspec.structs.replace(limits, lanes="portable")
    points, pixels, camera = each.points_world, each.pixels, each.camera
    return (
        outcome(lambda: solve_pnp(points, pixels, camera, OPTIONS, default_engine=OLD)),
        outcome(lambda: solver.solve(points, pixels, camera, limits)),
        outcome(lambda: solver.solve(points, pixels, camera, narrow)),
        outcome(lambda: solve_pnp(points, pixels, camera, OPTIONS, default_engine=PYTHON)),
    )


def spread_mm(metres: list[float]) -> dict[str, Any]:
    """Return the spread, in millimetres."""

    return spread(1e3 * value for value in metres)


@references()
def compare(cases: Iterator[Case]) -> dict[str, Any]:
    """Return success, error and verdicts of PoseLib and the native solver on the same problems.

    A right pose lies within 0.1 m and 2 degrees of the truth.  Errors are compared where both are right.
    """
    tally: dict[str, Counter[str]] = {}
    verdicts: Counter[str] = Counter()
    errors_m: dict[str, list[float]] = {"poselib": [], "native": []}
    apart_m: list[float] = []
    lanes_differ = evidence_differs = 0
    for problem in cases:
        old, ours, without_avx2, python = judgements(problem)
        lanes_differ += ours[:2] != without_avx2[:2] or not same_bytes(ours[2], without_avx2[2])
        evidence_differs += ours[:2] != python[:2]
        row = tally.setdefault(problem.kind, Counter())
        row["n"] += 1
        if ours[0] != old[0]:
            verdicts[f"{problem.kind}: {old[0]} -> {ours[0]}"] += 1
        if ours[2] is not None and old[2] is not None:
            apart_m.append(pose_difference(ours[2].T_camera_world, old[2].T_camera_world)[0])
        right = {}
        for name, (verdict, _, solution) in (("poselib", old), ("native", ours)):
            row[f"{name} ok"] += verdict == "ok"
            if solution is None or problem.T_camera_world is None:
                continue
            metres, degrees = pose_difference(solution.T_camera_world, problem.T_camera_world)
            if metres < RIGHT_M and degrees < RIGHT_DEG:
                right[name] = metres
                row[f"{name} right"] += 1
                row[f"{name} right and ok"] += verdict == "ok"
            else:
                row[f"{name} wrong and ok"] += verdict == "ok"
        if len(right) == 2:
            for name, metres in right.items():
                errors_m[name].append(metres)
    total: Counter[str] = sum(tally.values(), Counter())
    return {
        "kinds": {kind: dict(row) for kind, row in sorted(tally.items())},
        "all": dict(total),
        "error_mm": {name: spread_mm(values) for name, values in errors_m.items() if values},
        "apart_mm": spread_mm(apart_m) if apart_m else {},
        "other_verdict_than_old": dict(verdicts.most_common()),
        "other_bytes_without_avx2": lanes_differ,
        "other_verdict_than_python_on_the_same_pose": evidence_differs,
    }  # fmt: skip


def normalised_errors(problems: int, outlier_ratio: float) -> dict[str, float]:
    """Return the mean of the squared errors in units of the covariance; 6 if it is honest."""
    solver, limits = native.native_solver(), engines.native_options(OPTIONS, LIMITS)
    errors2 = []
    for seed in range(problems):
        p = make_problem(seed=seed, n=100, outlier_ratio=outlier_ratio)
        solution = solver.solve(p.points_world, p.pixels, KINECT, limits)
        D = p.T_camera_world @ inverse(solution.T_camera_world)
        turn = [D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]
        xi = np.array([*D[:3, 3], *(0.5 * np.array(turn))])
        errors2.append(float(xi @ np.linalg.solve(solution.covariance, xi)))
    return {"n": problems, "outlier_ratio": outlier_ratio, "mean": float(np.mean(errors2))}


@benchmark(
    *(Bar(f"cpu_ratio.{percent} %", at_least=6.0) for percent in (30, 50, 70)),
    Bar("problems.wrong_and_ok", equals=0),
    Bar("degenerate.wrong_and_ok", equals=0),
    Bar("*.other_bytes_without_avx2", equals=0),
    Bar("normalised_errors.*.mean", at_least=5.4),
    Bar("normalised_errors.*.mean", at_most=6.6),
)
def run_benchmark(
    *,
    n: Annotated[int, "problems of all kinds together"] = 1000,
    cpu_n: Annotated[int, "problems a row of the CPU table"] = 500,
) -> dict[str, Any]:
    """Compare with PoseLib."""
    lanes = native.native_solver().lanes
    cpu = measure_cpu(cpu_n)
    compared = {
        "problems": compare(map(case, range(n))),
        "degenerate": compare(map(degenerate, range(max(14, n // 10)))),
        **({"recordings": compare(recorded_cases(RECORDINGS))} if RECORDINGS.is_dir() else {}),
    }
    for row in compared.values():
        row["wrong_and_ok"] = row["all"].get("native wrong and ok", 0)
    return {
        "lanes": lanes, "cpu": cpu, **compared,
        "cpu_ratio": {f"{row['outlier_percent']} %": row["ratio"] for row in cpu if row["matches"] == 200},
        "normalised_errors": [normalised_errors(1000, 0.0), normalised_errors(1000, 0.3)],
    }  # fmt: skip
