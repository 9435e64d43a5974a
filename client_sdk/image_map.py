"""Images of one camera mapped to the pixels of another, as computed once for all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import load_opencv

__all__ = ["ImageMap"]


class ImageMap:
    """Map images by the *maps* of OpenCV's ``initUndistortRectifyMap``; None leaves them as they are."""

    def __init__(self, maps: tuple[Any, Any] | None) -> None:
        self._maps = maps

    def colour(self, rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return a colour image, interpolated."""
        if self._maps is None:
            return rgb
        cv2 = load_opencv()
        mapped: npt.NDArray[np.uint8] = cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR)
        return mapped

    def depth(self, depth_m: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Return a depth image with the nearest readings: a mean of two surfaces lies on neither."""
        if self._maps is None:
            return depth_m
        cv2 = load_opencv()
        mapped: npt.NDArray[np.float32] = cv2.remap(depth_m, *self._maps, cv2.INTER_NEAREST)
        return mapped
