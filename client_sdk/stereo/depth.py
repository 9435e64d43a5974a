"""Depths of a rectified stereo pair at the features of its left image, and the noise of these depths."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from client_sdk.stereo.view import StereoView
from rse_pf.geometry import Array, Camera
from rse_pf.images import load_opencv
from rse_pf.pnp import DepthNoise
from rse_pf.slam.stereo import StereoOptions, disparities, stereo_noise

__all__ = ["noise_of", "stereo_points", "with_offset"]

_NEAREST_M = 0.3
"""Smallest depth of a stereo point, in metres: it limits the largest disparity that is searched."""
_FARTHEST_M = 900.0
"""Largest depth of a stereo point, in metres: it limits the smallest disparity that is accepted."""
_MAX_DISPARITY_SHARE = 0.2
"""Largest disparity that is searched, as a share of the image width: points with larger disparities are few,
and without this limit a search takes half as long again."""
_MAX_DISPARITY_PX = 512
"""Largest disparity that is searched, in pixels, however wide the image."""
_MIN_DISPARITY_PX = 1.0
"""Smallest disparity that is accepted, in pixels: the depths of smaller ones are nearly unknown."""
_DISPARITY_SIGMA_PX = 0.1
"""Standard deviation of a disparity in a sharp image, in pixels; the tracker estimates by which factor other
images are worse."""


def stereo_points(rgb: npt.NDArray[np.uint8], stereo: StereoView, camera: Camera, pixels: Array) -> Array:
    """Return the points that a stereo pair shows at given pixels of its left image.

    Args:
        rgb: ``(h, w, 3)``, the rectified left image, red first.
        stereo: The right image, and the baseline.
        camera: Intrinsics of both images.
        pixels: ``(n, 2)``, column and row in the left image.

    Returns:
        ``(n, 3)`` metres in the left camera's frame; NaN where no disparity was found.  The smallest
        disparity is the larger one of 1 px and that of 900 m; the largest is the smallest one of 512 px, a
        fifth of the width, and that of 0.3 m.

    Raises:
        MissingExtra: OpenCV or the native core is not installed.
    """
    f_baseline = camera.fx * stereo.baseline_m
    max_px = int(min(f_baseline / _NEAREST_M, _MAX_DISPARITY_SHARE * camera.width, _MAX_DISPARITY_PX))
    min_px = max(_MIN_DISPARITY_PX, f_baseline / _FARTHEST_M)
    if max_px < min_px:
        return np.full((len(pixels), 3), np.nan)
    options = StereoOptions(min_disparity_px=min_px, max_disparity_px=max_px)
    cv2 = load_opencv()
    disparities_px = disparities(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), stereo.gray, pixels, options)
    return camera.back_project(pixels, f_baseline / disparities_px)


def noise_of(stereo: StereoView, camera: Camera) -> DepthNoise:
    """Return the noise model of a stereo pair's depths in sharp images."""
    return stereo_noise(camera.fx * stereo.baseline_m, _DISPARITY_SIGMA_PX)


def with_offset(points_camera: Array, f_baseline: float, offset_px: float) -> Array:
    """Return stereo points after an offset was added to the disparities; each point moves along its ray.

    Args:
        points_camera: ``(n, 3)`` metres, in the left camera's frame, NaN without depth.
        f_baseline: Focal length in pixels times the baseline in metres.
        offset_px: Pixels that are added to every disparity.

    Returns:
        ``(n, 3)`` metres; NaN without depth, and where the disparity would not be above 0.
    """
    stretch = 1.0 + points_camera[:, 2:] * (offset_px / f_baseline)
    moved: Array = points_camera / np.where(stretch > 0.0, stretch, np.nan)
    return moved
