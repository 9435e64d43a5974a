"""Undistort and rectify images: look up for each new pixel where it lies in the old image."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import load_opencv
from rse_pf.geometry import Camera, Lens

__all__ = ["ImageMap", "map_to_pinhole"]


class ImageMap:
    """Resample images with the two *maps* of ``cv2.initUndistortRectifyMap``, computed once for all images.

    With None for the maps, images are returned as they are.
    """

    def __init__(self, maps: tuple[Any, Any] | None) -> None:
        self._maps = maps

    def colour(self, rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the resampled image of a colour or grey image, with bilinear interpolation."""
        if self._maps is None:
            return rgb
        cv2 = load_opencv()
        mapped: npt.NDArray[np.uint8] = cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR)
        return mapped

    def depth(self, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return the resampled image of a depth image, each pixel with the nearest reading.

        Interpolation between two surfaces would make up depths at which there is no surface.
        """
        if self._maps is None:
            return depth_m
        cv2 = load_opencv()
        mapped: npt.NDArray[np.float32] = cv2.remap(depth_m, *self._maps, cv2.INTER_NEAREST)
        return mapped


def map_to_pinhole(lens: Lens, camera: Camera | None = None) -> ImageMap:
    """Return the map from images of *lens* to those of a pinhole *camera* at the same pose.

    None for the camera keeps the intrinsics of the lens, and removes its distortion only.

    Raises:
        MissingExtra: OpenCV is not installed, and images must be resampled.
    """
    wanted = lens.camera if camera is None else camera
    if lens.is_pinhole and lens.camera == wanted:
        return ImageMap(None)
    return ImageMap(lens.undistortion_maps(wanted))
