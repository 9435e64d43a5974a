"""The pinhole camera: projection of points to pixels, and back."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np

from rse_pf.errors import InvalidCamera
from rse_pf.geometry.transforms import Array

__all__ = ["Camera"]

# Largest width or height of an image in pixels: no sensor of a robot is larger; a larger number is refused.
MAX_IMAGE_SIDE_PX = 16384
# Smallest focal length, as a multiple of the longer side of the image: a smaller one is refused, because it
# is in another unit, such as millimetres.
MIN_FOCAL_LENGTH = 0.05
# Largest focal length, as a multiple of the longer side of the image: a larger one is refused, because no
# robot carries such a telescope.
MAX_FOCAL_LENGTH = 100.0


class Camera(msgspec.Struct, frozen=True, kw_only=True):
    """The pinhole intrinsics of undistorted images, in pixels.

    ``fx`` and ``fy`` are the focal lengths, ``cx`` and ``cy`` the principal point, ``width`` and ``height``
    the size of the image.

    Raises:
        InvalidCamera: A number is not finite, a side of the image is not within 1 to 16384 px, a focal length
            is not within 0.05 to 100 times the longer side of the image, or the principal point lies more
            than the width of the image to the left or right of its centre, or more than its height above or
            below.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: Annotated[int, msgspec.Meta(ge=1)]
    height: Annotated[int, msgspec.Meta(ge=1)]

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in (self.fx, self.fy, self.cx, self.cy)):
            raise InvalidCamera("an intrinsic is not a finite number", hint="send fx fy cx cy in pixels")
        longer_side = max(self.width, self.height)
        if not (1 <= self.width <= MAX_IMAGE_SIDE_PX and 1 <= self.height <= MAX_IMAGE_SIDE_PX):
            raise InvalidCamera(
                f"image size {self.width}x{self.height} is not within 1..{MAX_IMAGE_SIDE_PX} px",
                hint="send the size of the image the pixels come from",
            )
        for name, focal_length in (("fx", self.fx), ("fy", self.fy)):
            if not MIN_FOCAL_LENGTH * longer_side <= focal_length <= MAX_FOCAL_LENGTH * longer_side:
                raise InvalidCamera(
                    f"{name} = {focal_length:g} px is absurd for an image of {self.width}x{self.height} px",
                    hint="send the focal length in pixels of this image size",
                )
        if abs(self.cx - self.width / 2) > self.width or abs(self.cy - self.height / 2) > self.height:
            raise InvalidCamera(
                f"the principal point ({self.cx:g}, {self.cy:g}) lies far outside "
                f"{self.width}x{self.height} px",
                hint="send cx cy in pixels of this image size",
            )

    @property
    def matrix(self) -> Array:
        """The ``(3, 3)`` camera matrix K, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points_camera: Array) -> Array:
        """Return the ``(n, 2)`` pixels of ``(n, 3)`` points of the camera frame, whose z must be above 0."""
        z = points_camera[:, 2]
        pixels = np.empty((len(points_camera), 2))
        pixels[:, 0] = self.fx * points_camera[:, 0] / z + self.cx
        pixels[:, 1] = self.fy * points_camera[:, 1] / z + self.cy
        return pixels

    def back_project(self, pixels: Array, depth_m: Array) -> Array:
        """Return the ``(n, 3)`` points of the camera frame, m, seen at ``(n, 2)`` pixels.

        *depth_m* ``(n,)`` is their depth along the optical axis (z), not along the ray.
        """
        points = np.empty((len(pixels), 3))
        points[:, 0] = (pixels[:, 0] - self.cx) / self.fx * depth_m
        points[:, 1] = (pixels[:, 1] - self.cy) / self.fy * depth_m
        points[:, 2] = depth_m
        return points
