"""Points of a rectified stereo pair at the features of its left image, and their noise."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from client_sdk.stereo.view import StereoView
from rse_pf.geometry import Array, Camera
from rse_pf.images import load_opencv
from rse_pf.pnp import DepthNoise
from rse_pf.slam.stereo import StereoOptions, disparities, stereo_noise

__all__ = ["noise_of", "stereo_points", "with_offset"]

_NEAREST_M, _FARTHEST_M = 0.3, 900.0
_MOST_SHARE, _MOST_PX = 0.2, 512
"""Disparities up to this share of the width are sought: a third of the time is spent on what is near."""
_DISPARITY_PX = 0.1
"""Deviation of a disparity in a clear picture; the tracker estimates by how much others are worse."""


def stereo_points(rgb: npt.NDArray[np.uint8], stereo: StereoView, camera: Camera, pixels: Array) -> Array:
    """Return the ``(n, 3)`` points of the left camera's frame that a pair shows at ``(n, 2)`` pixels.

    Points without a disparity are NaN.  What is near is limited to 0.3 m and disparities of a fifth of the
    width, what is far by a disparity of 1 px and 900 m.

    Args:
        rgb: ``(h, w, 3)``, the rectified left image.
        stereo: The right image, and the baseline.
        camera: Of both.
        pixels: In the left image.
    """
    f_baseline = camera.fx * stereo.baseline_m
    most = int(min(f_baseline / _NEAREST_M, _MOST_SHARE * camera.width, _MOST_PX))
    least = max(1.0, f_baseline / _FARTHEST_M)
    if most < least:
        return np.full((len(pixels), 3), np.nan)
    options = StereoOptions(min_disparity_px=least, max_disparity_px=most)
    cv2 = load_opencv()
    found = disparities(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), stereo.gray, pixels, options)
    return camera.back_project(pixels, f_baseline / found)


def noise_of(stereo: StereoView, camera: Camera) -> DepthNoise:
    """Return the noise of a pair's depths where its pictures are clear."""
    return stereo_noise(camera.fx * stereo.baseline_m, _DISPARITY_PX)


def with_offset(points_camera: Array, f_baseline: float, offset_px: float) -> Array:
    """Return ``(n, 3)`` points along their rays, as disparities that are *offset_px* larger have them.

    A point that has none, or whose disparity would not be above 0, is NaN.

    Args:
        points_camera: ``(n, 3)``, of the left camera's frame.
        f_baseline: Focal length in pixels times the baseline in metres.
        offset_px: Pixels.
    """
    stretch = 1.0 + points_camera[:, 2:] * (offset_px / f_baseline)
    moved: Array = points_camera / np.where(stretch > 0.0, stretch, np.nan)
    return moved
