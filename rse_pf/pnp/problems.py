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
    "make_degenerate",
    "make_problem",
]

KINECT = Camera(fx=518.86, fy=519.47, cx=325.58, cy=253.74, width=640, height=480)
"""Intrinsics of the colour camera of NYU Depth V2, a Kinect, from the calibration of its toolbox."""

_MIN_DEPTH_M = 0.8  # nearest point of a problem, metres: the shortest range of a Kinect
_MAX_DEPTH_M = 6.0  # farthest point of a problem, metres: the size of a room
# Width (pixels) of the border of the image on which no point is projected before noise is added, so that the
# noisy pixels of inliers lie inside the image.
_BORDER_PX = 8.0

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
    camera: Camera = KINECT,
) -> PnpProblem:
    """Make a PnP problem with points 0.8 to 6 m in front of the camera.

    Args:
        seed: Seed of the random generator.
        n: Number of correspondences.
        noise_px: Standard deviation of the noise of each pixel coordinate.
        outlier_ratio: Share of the correspondences whose pixel is random.
        camera: Intrinsics.
    """
    rng = np.random.default_rng(seed)
    T_camera_world = exp_se3(np.concatenate([rng.uniform(-2, 2, 3), rng.normal(size=3) * 0.6]))
    size = np.array([camera.width, camera.height], dtype=np.float64)
    exact_pixels = rng.uniform(_BORDER_PX, size - _BORDER_PX, (n, 2))
    depth_m = rng.uniform(_MIN_DEPTH_M, _MAX_DEPTH_M, n)
    points_world = transform(inverse(T_camera_world), camera.back_project(exact_pixels, depth_m))
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
