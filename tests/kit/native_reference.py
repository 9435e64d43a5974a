"""Compare the native solver with PoseLib, the engine of version 0.1.0, on the same random problems."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest

from rse_pf.errors import RsePfError
from rse_pf.geometry import Array, Camera, exp_se3, inverse, pose_difference, transform
from rse_pf.pnp import PnpOptions, WeakLimits, engines, solve_pnp
from rse_pf.pnp.native_solver import Evidence, native_solver
from rse_pf.pnp.problems import DEGENERATE, KINECT, make_degenerate, make_problem
from tests.kit.two_views import add_depth_noise

EVERY = pytest.mark.parametrize("engine", ["native", "opencv"])
RIGHT_M, RIGHT_DEG = 0.1, 2.0
KINDS = ("room", "room", "room", "room", "plane", "near-line", "few", "few")
OPTIONS, LIMITS = PnpOptions(), WeakLimits()
OLD = "poselib of 0.1.0"


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A PnP problem; ``T_camera_world`` is None where the correspondences determine no pose."""

    kind: str
    points_world: Array
    pixels: Array
    T_camera_world: Array | None
    camera: Camera = KINECT


def with_depth_noise(rng: np.random.Generator, points_world: Array, T_camera_world: Array) -> Array:
    """Return points that are moved along their rays by the depth error of a Kinect."""
    points_camera = transform(T_camera_world, points_world)
    depth_m = points_camera[:, 2]
    return transform(
        inverse(T_camera_world), points_camera * (add_depth_noise(rng, depth_m) / depth_m)[:, None]
    )


def case(number: int) -> Case:
    """Return problem *number*: a room, a plane, a line or few points; equal numbers give equal problems."""
    kind, seed = KINDS[number % len(KINDS)], number // len(KINDS)
    rng = np.random.default_rng(number)
    if kind == "room":
        seed = 4 * seed + number % len(KINDS)
        tenths = 1 + seed % 8
        problem = make_problem(
            seed=number, n=(30, 60, 100, 200, 300)[seed // 8 % 5], outlier_ratio=tenths / 10,
        )  # fmt: skip
        T, points = problem.T_camera_world, problem.points_world
        if seed // 40 % 2 == 1:
            points = with_depth_noise(rng, points, T)
        return Case(f"room {10 * tenths} %", points, problem.pixels, T)
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
    """Return degenerate problem *number*, whose correspondences determine no pose."""
    kind = DEGENERATE[number % len(DEGENERATE)]
    problem = make_degenerate(kind, seed=number // len(DEGENERATE), n=(20, 100)[number % 2])
    return Case(kind, problem.points_world, problem.pixels, None)


def old_engine() -> engines.Engine:
    """Return an engine that estimates poses with PoseLib, as version 0.1.0 did."""
    import poselib

    def solve(
        points_world: Array, pixels: Array, camera: Camera, options: PnpOptions, weak: WeakLimits
    ) -> Evidence:
        model = {
            "model": "PINHOLE", "width": camera.width, "height": camera.height,
            "params": [camera.fx, camera.fy, camera.cx, camera.cy],
        }  # fmt: skip
        ransac = {
            "max_reproj_error": options.inlier_px, "max_iterations": options.max_iterations,
            "min_iterations": min(options.min_iterations, options.max_iterations),
            "success_prob": options.confidence,
        }  # fmt: skip
        pose = np.eye(4)
        pose[:3] = poselib.estimate_absolute_pose(pixels, points_world, model, ransac, {})[0].Rt
        limits = engines.native_options(options, weak)
        return native_solver().evaluate(points_world, pixels, camera, limits, pose)

    return solve


@contextlib.contextmanager
def references() -> Iterator[None]:
    """Register the engine of PoseLib for `solve_pnp`, and remove it at exit."""
    engines.ENGINES[OLD] = old_engine
    try:
        yield
    finally:
        del engines.ENGINES[OLD]


def accepted(evidence: Evidence) -> Evidence:
    """Return *evidence* of an accepted pose; raise the error of a refused pose."""
    if evidence.refusal is not None:
        raise evidence.refusal
    return evidence


def outcome(work: Callable[[], Any]) -> tuple[str, str, Any]:
    """Return the verdict or the name of the error, the text of the error, and the solution or None."""
    try:
        solution = work()
    except RsePfError as error:
        return type(error).__name__, f"{error.message}; {error.hint}", None
    return (f"weak: {solution.reason}" if solution.reason else "ok"), "", solution


def same_bytes(first: Evidence | None, second: Evidence | None) -> bool:
    """Return whether two results of the native solver are equal to the last bit."""
    if first is None or second is None:
        return first is second
    return all(
        np.asarray(getattr(first, name)).tobytes() == np.asarray(getattr(second, name)).tobytes()
        for name in Evidence.__struct_fields__
        if name not in ("reason", "refusal")
    )


def solve_with_all(problem: Case) -> tuple[tuple[str, str, Any], ...]:
    """Return the outcomes of PoseLib, of the native solver, and of the native solver without AVX2."""
    solver, limits = native_solver(), engines.native_options(OPTIONS, LIMITS)
    narrow = msgspec.structs.replace(limits, lanes="portable")
    points, pixels, camera = problem.points_world, problem.pixels, problem.camera
    return (
        outcome(lambda: solve_pnp(points, pixels, camera, OPTIONS, default_engine=OLD)),
        outcome(lambda: accepted(solver.evaluate(points, pixels, camera, limits))),
        outcome(lambda: accepted(solver.evaluate(points, pixels, camera, narrow))),
    )


@references()
def compare(cases: Iterator[Case]) -> dict[str, Any]:
    """Return success and error of PoseLib and the native solver on the same problems.

    A right pose lies within 0.1 m and 2 degrees of the truth.  Errors are compared where both are right.
    """
    tally: dict[str, Counter[str]] = {}
    errors_mm: dict[str, list[float]] = {"poselib": [], "native": []}
    lanes_differ = 0
    for problem in cases:
        old, ours, without_avx2 = solve_with_all(problem)
        lanes_differ += ours[:2] != without_avx2[:2] or not same_bytes(ours[2], without_avx2[2])
        row = tally.setdefault(problem.kind, Counter())
        row["n"] += 1
        right = {}
        for name, (verdict, _, solution) in (("poselib", old), ("native", ours)):
            if solution is None:
                continue
            metres, degrees = pose_difference(solution.T_camera_world, problem.T_camera_world)
            if metres < RIGHT_M and degrees < RIGHT_DEG:
                right[name] = 1e3 * metres
                row[f"{name} right"] += 1
                row[f"{name} right and ok"] += verdict == "ok"
            else:
                row[f"{name} wrong and ok"] += verdict == "ok"
        if len(right) == 2:
            for name, millimetres in right.items():
                errors_mm[name].append(millimetres)
    return {
        "kinds": tally,
        "all": sum(tally.values(), Counter()),
        "error_mm": {name: np.percentile(values, [50, 95]) for name, values in errors_mm.items()},
        "other_bytes_without_avx2": lanes_differ,
    }


def mean_normalised_error(problems: int, outlier_ratio: float) -> float:
    """Return the mean normalised estimation error squared (NEES); 6 for a correct covariance."""
    solver, limits = native_solver(), engines.native_options(OPTIONS, LIMITS)
    errors2 = []
    for seed in range(problems):
        p = make_problem(seed=seed, n=100, outlier_ratio=outlier_ratio)
        solution = solver.evaluate(p.points_world, p.pixels, KINECT, limits)
        D = p.T_camera_world @ inverse(solution.T_camera_world)
        turn = [D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]
        xi = np.array([*D[:3, 3], *(0.5 * np.array(turn))])
        errors2.append(float(xi @ np.linalg.solve(solution.covariance, xi)))
    return float(np.mean(errors2))
