"""Seeded PnP problems with known poses, for tests and benchmarks; equal arguments give equal problems."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rse_pf.geometry import Array, Camera, exp_se3, inverse, transform

__all__ = [
    "DEGENERATE",
    "KINECT",
    "PnpProblem",
    "TwoViews",
    "make_degenerate",
    "make_problem",
    "make_two_views",
]

KINECT = Camera(fx=518.86, fy=519.47, cx=325.58, cy=253.74, width=640, height=480)
"""The colour camera of NYU Depth V2 (its toolbox's calibration)."""

_MIN_DEPTH_M, _MAX_DEPTH_M, _BORDER_PX = 0.8, 6.0, 8.0

DEGENERATE = (
    "collinear", "noisy-collinear", "strayed-collinear", "coincident", "same-pixel", "line-of-sight",
    "duplicated", "noise", "behind", "mirrored", "corner", "nan", "infinite", "huge",
)  # fmt: skip
"""Kinds of correspondences that fix no pose; for ``duplicated``, four wrong ones are repeated."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PnpProblem:
    """Correspondences and their true pose."""

    points_world: Array
    pixels: Array
    camera: Camera
    T_camera_world: Array
    is_inlier: npt.NDArray[np.bool_]


def make_problem(
    *,
    seed: int,
    n: int = 200,
    noise_px: float = 1.0,
    outlier_ratio: float = 0.3,
    depth_noise: bool = False,
    camera: Camera = KINECT,
) -> PnpProblem:
    """Return *n* correspondences of a room-sized scene, *outlier_ratio* of them uniformly wrong.

    Points lie 0.8 to 6 m before the camera; with *depth_noise* they carry a Kinect's error.

    Source:
        Depth error after Nguyen et al., 3DIMPVT 2012.
    """
    rng = np.random.default_rng(seed)
    T_camera_world = exp_se3(np.concatenate([rng.uniform(-2, 2, 3), rng.normal(size=3) * 0.6]))
    size = np.array([camera.width, camera.height], dtype=np.float64)
    exact = rng.uniform(_BORDER_PX, size - _BORDER_PX, (n, 2))
    depth_m = rng.uniform(_MIN_DEPTH_M, _MAX_DEPTH_M, n)
    measured_m = depth_m
    if depth_noise:
        measured_m = _with_depth_noise(rng, depth_m)
    points_world = transform(inverse(T_camera_world), camera.back_project(exact, measured_m))
    pixels = exact + rng.normal(size=(n, 2)) * noise_px
    wrong = rng.permutation(n)[: round(outlier_ratio * n)]
    pixels[wrong] = rng.uniform(0, size, (len(wrong), 2))
    is_inlier = np.ones(n, dtype=np.bool_)
    is_inlier[wrong] = False
    return PnpProblem(
        points_world=points_world, pixels=pixels, camera=camera, T_camera_world=T_camera_world,
        is_inlier=is_inlier,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwoViews:
    """Matches of two depth images, rounded as they are sent; *depths_m* is 0 where there is none."""

    points_reference: Array
    pixels: Array
    depths_m: Array
    camera: Camera
    T_camera_reference: Array


def make_two_views(
    *, seed: int, n: int = 150, noise_px: float = 1.0, outlier_ratio: float = 0.2, missing_ratio: float = 0.1
) -> TwoViews:
    """Return matches of two views some 0.2 m apart, both with pixel noise and a Kinect's depth error.

    Points lie 1.5 to 4.5 m before the first camera; *missing_ratio* of the second one's depths are missing.
    """
    rng = np.random.default_rng(seed)
    T = exp_se3(np.concatenate([rng.uniform(-0.17, 0.17, 3), rng.normal(size=3) * 0.08]))
    exact, depth_m = rng.uniform(60.0, [580.0, 420.0], (n, 2)), rng.uniform(1.5, 4.5, n)
    seen = transform(T, KINECT.back_project(exact, depth_m))
    noisy = exact + rng.normal(size=(n, 2)) * noise_px
    points = KINECT.back_project(noisy, _with_depth_noise(rng, depth_m))
    pixels = KINECT.project(seen) + rng.normal(size=(n, 2)) * noise_px
    depths_m = _with_depth_noise(rng, seen[:, 2])
    wrong = rng.permutation(n)[: round(outlier_ratio * n)]
    pixels[wrong] = rng.uniform(0.0, [KINECT.width, KINECT.height], (len(wrong), 2))
    depths_m[wrong] = rng.uniform(1.0, 5.0, len(wrong))
    depths_m[rng.random(n) < missing_ratio] = 0.0
    return TwoViews(
        points_reference=np.round(points, 4), pixels=np.round(pixels, 2), depths_m=np.round(depths_m, 3),
        camera=KINECT, T_camera_reference=T,
    )  # fmt: skip


def _with_depth_noise(rng: np.random.Generator, depth_m: Array) -> Array:
    noisy: Array = depth_m + rng.normal(size=len(depth_m)) * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2)
    return noisy


def make_degenerate(kind: str, *, seed: int, n: int = 100, camera: Camera = KINECT) -> PnpProblem:
    """Return correspondences that fix no pose; *kind* is one of `DEGENERATE`."""
    rng = np.random.default_rng(seed)
    problem = make_problem(seed=seed, n=n, noise_px=0.5, outlier_ratio=0.0, camera=camera)
    T, points, pixels = problem.T_camera_world, problem.points_world, problem.pixels
    match kind:
        case "collinear" | "noisy-collinear" | "strayed-collinear":
            start = rng.uniform([-1.0, -0.7, 2.0], [1.0, 0.7, 4.0])
            direction = rng.normal(size=3) * [1.0, 1.0, 0.3]
            along = np.linspace(-0.5, 0.5, n)[:, None] * direction / np.linalg.norm(direction)
            line_camera = start + along
            pixels = camera.project(line_camera)
            points = transform(inverse(T), line_camera)
            if kind != "collinear":
                points = points + rng.normal(size=(n, 3)) * 0.005
                pixels = pixels + rng.normal(size=(n, 2)) * 0.5
            if kind == "strayed-collinear":
                pixels[: n // 10] = rng.uniform(0, [camera.width, camera.height], (n // 10, 2))
        case "coincident":
            points = np.repeat(points[:1], n, axis=0)
        case "same-pixel":
            pixels = np.repeat(pixels[:1], n, axis=0)
        case "line-of-sight":
            ray = camera.back_project(pixels[:1], np.ones(1))
            points = transform(inverse(T), ray * np.linspace(1, 5, n)[:, None])
            pixels = pixels[:1] + rng.normal(size=(n, 2)) * 0.5
        case "noise":  # of another stream: that of the seed has made the right pixels
            pixels = np.random.default_rng([seed, 1]).uniform(0, [camera.width, camera.height], (n, 2))
        case "behind":
            T = np.diag([-1.0, -1.0, 1.0, 1.0]) @ T
            points = transform(inverse(T), camera.back_project(pixels, -rng.uniform(1, 5, n)))
        case "mirrored":
            points = points * [-1.0, 1.0, 1.0]
        case "corner":
            pixels = rng.uniform(20.0, 25.0, (n, 2))
            points = transform(inverse(T), camera.back_project(pixels, rng.uniform(1, 5, n)))
        case "duplicated":
            four = rng.integers(0, 4, n)
            points, pixels = points[four], np.roll(pixels, 7, axis=0)[four] + rng.normal(size=(n, 2)) * 0.5
        case "nan" | "infinite" | "huge":
            points = points.copy()
            points[rng.integers(n), 1] = {"nan": np.nan, "infinite": np.inf, "huge": 1e300}[kind]
        case _:
            raise ValueError(f"unknown kind {kind!r}")
    return PnpProblem(
        points_world=points, pixels=pixels, camera=camera, T_camera_world=T,
        is_inlier=np.zeros(n, dtype=np.bool_),
    )  # fmt: skip
