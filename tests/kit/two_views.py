"""Correspondences of two depth images with their true relative pose, and the noise of a Kinect's depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rse_pf.geometry import Array, Camera, exp_se3, transform
from rse_pf.pnp.problems import KINECT

__all__ = ["TwoViews", "add_depth_noise", "make_two_views"]


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
    points = KINECT.back_project(noisy_pixels, add_depth_noise(rng, depth_m))
    pixels = KINECT.project(points_camera) + rng.normal(size=(n, 2)) * noise_px
    depths_m = add_depth_noise(rng, points_camera[:, 2])
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


def add_depth_noise(rng: np.random.Generator, depth_m: Array) -> Array:
    """Return depths (metres) with the noise of a Kinect (Nguyen et al. 2012, eq. 5), a new array."""
    return depth_m + rng.normal(size=len(depth_m)) * (0.0012 + 0.0019 * (depth_m - 0.4) ** 2)
