"""Make random PnP problems with known poses for tests and benchmarks; equal arguments give equal problems."""

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
"""Intrinsics of the colour camera of NYU Depth V2, a Kinect, from the calibration of its toolbox."""

_MIN_DEPTH_M = 0.8  # nearest point of a problem, metres: the shortest range of a Kinect
_MAX_DEPTH_M = 6.0  # farthest point of a problem, metres: the size of a room
_BORDER_PX = 8.0  # pixels along the border of the image without points, so that noise keeps them inside

DEGENERATE = (
    "collinear",
    "noisy-collinear",
    "strayed-collinear",
    "coincident",
    "same-pixel",
    "line-of-sight",
    "duplicated",
    "noise",
    "behind",
    "mirrored",
    "corner",
    "nan",
    "infinite",
    "huge",
)
"""Kinds of correspondences that determine no pose, for `make_degenerate`.

``collinear`` has points on one line, ``noisy-collinear`` with noise of 5 mm and 0.5 px, and
``strayed-collinear`` with one tenth of outliers besides.  ``coincident`` has one point for all rows, and
``same-pixel`` one pixel; ``line-of-sight`` has points on one ray of the camera.  ``duplicated`` repeats four
wrong correspondences with pixel noise; ``noise`` has random pixels; ``behind`` has points behind the camera;
``mirrored`` has points reflected in the plane x = 0 of the world; ``corner`` has all pixels in a square of
5 px.  ``nan``, ``infinite`` and ``huge`` (1e300) name the value of one coordinate of one point.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PnpProblem:
    """Correspondences with their true pose.

    Attributes:
        points_world: ``(n, 3)``, metres, world frame.
        pixels: ``(n, 2)``, undistorted; row *i* observes point *i*.
        camera: Intrinsics.
        T_camera_world: ``(4, 4)``, the true pose, which maps world points (metres) to the camera frame.
        is_inlier: ``(n,)``, whether the pixel is the projection of the point with noise, and not a random
            pixel.
    """

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
    """Make a PnP problem with points 0.8 to 6 m in front of the camera.

    Args:
        seed: Seed of the random generator.
        n: Number of correspondences.
        noise_px: Standard deviation of the noise of each pixel coordinate.
        outlier_ratio: Share of the correspondences whose pixel is random.
        depth_noise: Whether each point is moved along its ray by the depth error of a Kinect.
        camera: Intrinsics.

    Source:
        Depth error after Nguyen et al., 3DIMPVT 2012.
    """
    rng = np.random.default_rng(seed)
    T_camera_world = exp_se3(np.concatenate([rng.uniform(-2, 2, 3), rng.normal(size=3) * 0.6]))
    size = np.array([camera.width, camera.height], dtype=np.float64)
    exact_pixels = rng.uniform(_BORDER_PX, size - _BORDER_PX, (n, 2))
    depth_m = rng.uniform(_MIN_DEPTH_M, _MAX_DEPTH_M, n)
    measured_m = _add_depth_noise(rng, depth_m) if depth_noise else depth_m
    points_world = transform(inverse(T_camera_world), camera.back_project(exact_pixels, measured_m))
    pixels = exact_pixels + rng.normal(size=(n, 2)) * noise_px
    outliers = rng.permutation(n)[: round(outlier_ratio * n)]
    pixels[outliers] = rng.uniform(0, size, (len(outliers), 2))
    is_inlier = np.ones(n, dtype=np.bool_)
    is_inlier[outliers] = False
    return PnpProblem(
        points_world=points_world,
        pixels=pixels,
        camera=camera,
        T_camera_world=T_camera_world,
        is_inlier=is_inlier,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TwoViews:
    """Correspondences of two depth images with their true relative pose, rounded as a ``pnp`` command is.

    Attributes:
        points_reference: ``(n, 3)``, metres, in the frame of the first camera, which measured them.
        pixels: ``(n, 2)``, in the second image; row *i* observes point *i*, except for outliers.
        depths_m: ``(n,)``, depths that the second camera measured at these pixels; 0 where there is none.
        camera: Intrinsics of both images.
        T_camera_reference: ``(4, 4)``, the true pose, which maps the first camera's frame to the second's.
    """

    points_reference: Array
    pixels: Array
    depths_m: Array
    camera: Camera
    T_camera_reference: Array


def make_two_views(
    *, seed: int, n: int = 150, noise_px: float = 1.0, outlier_ratio: float = 0.2, missing_ratio: float = 0.1
) -> TwoViews:
    """Make correspondences of two depth images taken about 0.2 m apart, with the noise of a Kinect in both.

    Points lie 1.5 to 4.5 m in front of the first camera.

    Args:
        seed: Seed of the random generator.
        n: Number of correspondences.
        noise_px: Standard deviation of the noise of each pixel coordinate in both images.
        outlier_ratio: Share of the correspondences whose second pixel and depth are random.
        missing_ratio: Share of the depths in the second image that are missing.
    """
    rng = np.random.default_rng(seed)
    T = exp_se3(np.concatenate([rng.uniform(-0.17, 0.17, 3), rng.normal(size=3) * 0.08]))
    exact_pixels, depth_m = rng.uniform(60.0, [580.0, 420.0], (n, 2)), rng.uniform(1.5, 4.5, n)
    points_camera = transform(T, KINECT.back_project(exact_pixels, depth_m))
    noisy_pixels = exact_pixels + rng.normal(size=(n, 2)) * noise_px
    points = KINECT.back_project(noisy_pixels, _add_depth_noise(rng, depth_m))
    pixels = KINECT.project(points_camera) + rng.normal(size=(n, 2)) * noise_px
    depths_m = _add_depth_noise(rng, points_camera[:, 2])
    outliers = rng.permutation(n)[: round(outlier_ratio * n)]
    pixels[outliers] = rng.uniform(0.0, [KINECT.width, KINECT.height], (len(outliers), 2))
    depths_m[outliers] = rng.uniform(1.0, 5.0, len(outliers))
    depths_m[rng.random(n) < missing_ratio] = 0.0
    return TwoViews(
        points_reference=np.round(points, 4),
        pixels=np.round(pixels, 2),
        depths_m=np.round(depths_m, 3),
        camera=KINECT,
        T_camera_reference=T,
    )


def _add_depth_noise(rng: np.random.Generator, depth_m: Array) -> Array:
    """Return depths (metres) with the noise of a Kinect (Nguyen et al. 2012, eq. 5), a new array."""
    noisy_m: Array = depth_m + rng.normal(size=len(depth_m)) * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2)
    return noisy_m


def make_degenerate(kind: str, *, seed: int, n: int = 100, camera: Camera = KINECT) -> PnpProblem:
    """Make *n* correspondences that determine no pose.

    Args:
        kind: One of `DEGENERATE`.
        seed: Seed of the random generator.
        n: Number of correspondences.
        camera: Intrinsics.

    Returns:
        The correspondences, none of which is called an inlier, with the pose from which they were made.

    Raises:
        ValueError: There is no such kind.
    """
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
        case "noise":
            # Another random stream: that of the seed would repeat the numbers from which `make_problem` made
            # the pixels.
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
        points_world=points,
        pixels=pixels,
        camera=camera,
        T_camera_world=T,
        is_inlier=np.zeros(n, dtype=np.bool_),
    )
