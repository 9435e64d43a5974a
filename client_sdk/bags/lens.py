"""The camera of a ROS ``CameraInfo`` message, and its images without the distortion of its lens."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.frontend import load_opencv
from client_sdk.image_map import ImageMap
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig import Rig
from client_sdk.rigs.rig_file import read_calibration
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.geometry import Array, Camera

__all__ = ["Lens", "Rectifier", "lens_of", "lens_or_rig", "numbers_of"]

_BROWN = {"plumb_bob", "rational_polynomial", "rational_polynomial_thin_prism", "brown_conrady"}
_FISHEYE = {"equidistant", "kannala_brandt4", "fisheye"}
_HINT = "give the intrinsics yourself: --intrinsics intrinsics.json"


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """A camera and the distortion of its lens; ``is_fisheye``: by OpenCV's fisheye model of four numbers."""

    camera: Camera
    distortion: tuple[float, ...] = ()
    is_fisheye: bool = False

    @classmethod
    def of(cls, intrinsics: Intrinsics) -> Lens:
        """Return the lens of a calibration."""
        return cls(
            camera=intrinsics.camera,
            distortion=intrinsics.distortion,
            is_fisheye=intrinsics.model == "fisheye",
        )

    def rays(self, pixels: Array) -> Array:
        """Return the directions ``(n, 3)``, of length 1, of what is seen at ``(n, 2)`` *pixels*."""
        cv2 = load_opencv()
        undistort = cv2.fisheye.undistortPoints if self.is_fisheye else cv2.undistortPoints
        distortion = np.array(self.distortion or (0.0, 0.0, 0.0, 0.0))
        seen = undistort(pixels.reshape(-1, 1, 2), self.camera.matrix, distortion).reshape(-1, 2)
        rays = np.column_stack((seen, np.ones(len(seen))))
        directions: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return directions


def lens_or_rig(file: Path) -> tuple[Lens | None, Rig | None]:
    """Return what a file of intrinsics, or of a rig, holds: ``lens`` and ``rig`` of `BagOptions`.

    Raises:
        UsageError: The file is neither.
    """
    own = read_calibration(file)
    return (Lens.of(own), None) if isinstance(own, Intrinsics) else (None, own)


def lens_of(message: Any, topic: str, *, is_rectified: bool) -> Lens:
    """Return the lens of a ``CameraInfo``; that of rectified images has the matrix P and no distortion.

    Numbers are those of the whole sensor; the lens is that of the region of interest after binning (REP 104).

    Raises:
        UsageError: The camera is not calibrated, or the model of its lens is unknown.
    """
    K, P, D = (numbers_of(message, name) for name in "kpd")
    if is_rectified and np.any(P):
        fx, cx, fy, cy = P[0], P[2], P[5], P[6]
        D = np.zeros(0)
    else:
        fx, cx, fy, cy = K[0], K[2], K[4], K[5]
    roi, width, height = message.roi, int(message.width), int(message.height)
    across, down = max(1, message.binning_x), max(1, message.binning_y)
    if (roi.width, roi.height, across, down) not in ((0, 0, 1, 1), (width, height, 1, 1)):
        # The centre of the first pixel is (0, 0), so that the corner of the image is at -0.5.
        fx, cx = fx / across, (cx - roi.x_offset + 0.5) / across - 0.5
        fy, cy = fy / down, (cy - roi.y_offset + 0.5) / down - 0.5
        width, height = (roi.width or width) // across, (roi.height or height) // down
    model = str(message.distortion_model).lower().replace(" ", "_")
    has_distortion = bool(np.any(D))
    if has_distortion and model not in _BROWN | _FISHEYE:
        raise UsageError(f"{topic} has a lens of the unknown model {model or '(none)'}", hint=_HINT)
    is_fisheye = has_distortion and model in _FISHEYE
    if has_distortion and (
        len(D) not in ((4,) if is_fisheye else (4, 5, 8, 12, 14)) or not np.isfinite(D).all()
    ):
        raise UsageError(f"{topic} has {len(D)} distortion numbers for {model}", hint=_HINT)
    try:
        camera = Camera(
            fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy),
            width=width, height=height,
        )  # fmt: skip
    except InvalidCamera as error:
        raise UsageError(f"{topic} holds no calibration: {error.message}", hint=_HINT) from error
    distortion = tuple(float(coefficient) for coefficient in D) if has_distortion else ()
    return Lens(camera=camera, distortion=distortion, is_fisheye=is_fisheye)


class Rectifier(ImageMap):
    """Map the images of a lens to a pinhole camera; with no distortion, images stay as they are."""

    def __init__(self, lens: Lens, wanted: Camera) -> None:
        if not lens.distortion and lens.camera == wanted:
            super().__init__(None)
            return
        cv2 = load_opencv()
        size = (wanted.width, wanted.height)
        undistort = cv2.fisheye.initUndistortRectifyMap if lens.is_fisheye else cv2.initUndistortRectifyMap
        distortion = np.array(lens.distortion or (0.0, 0.0, 0.0, 0.0))
        super().__init__(
            undistort(lens.camera.matrix, distortion, np.eye(3), wanted.matrix, size, cv2.CV_32FC1)
        )


def numbers_of(message: Any, name: str) -> Array:
    """Return ``d``, ``k``, ``r`` or ``p`` of a ``CameraInfo``; ROS 1 calls them by capital letters."""
    return np.ravel(getattr(message, name if hasattr(message, name) else name.upper()))
