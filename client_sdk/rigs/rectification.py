"""Rectify a stereo pair: both images as of two equal pinhole cameras side by side.

What is matched in them belongs to `client_sdk.stereo`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from client_sdk.frontend import load_opencv
from client_sdk.image_map import ImageMap
from client_sdk.rigs.intrinsics import Intrinsics, lens_maps
from client_sdk.rigs.rig import RigCamera
from client_sdk.stereo.view import StereoView
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.geometry import Array, Camera, inverse

__all__ = ["Rectification"]

_LEAST_BASELINE_M = 0.001
_RECTIFIED = 1e-9


class Rectification:
    """The rectified cameras of a pair, and the maps of its images.

    Attributes:
        camera: The pinhole camera of both rectified images.
        baseline_m: From the left camera to the right one.
        T_body_camera: ``(4, 4)``, pose of the rectified left camera in the body: it is turned against the
            left camera, and sits where that sits.

    Source:
        Bouguet's method, as OpenCV's ``stereoRectify`` (alpha 0) and ``fisheye.stereoRectify`` (balance 0)
        implement it.
    """

    def __init__(self, left: RigCamera, right: RigCamera) -> None:
        """Compute both maps.

        Raises:
            UsageError: The cameras do not make a pair: another size or model, the right one on the left, one
                above the other, or at one place.
            MissingExtra: OpenCV is not installed.
        """
        self._sizes = [(each.lens.camera.height, each.lens.camera.width) for each in (left, right)]
        T_right_left = inverse(right.T_body_camera) @ left.T_body_camera
        _check_pair(left, right, inverse(T_right_left)[:3, 3])
        if _is_rectified(left.lens, right.lens, T_right_left):
            self.camera = left.lens.camera
            self.baseline_m = float(-T_right_left[0, 3])
            self.T_body_camera = left.T_body_camera
            self._maps = (ImageMap(None), ImageMap(None))
            return
        cv2 = load_opencv()
        rotations, projections = _rectified(cv2, left.lens, right.lens, T_right_left)
        self.camera = _pinhole(projections[0], left.lens.camera)
        self.baseline_m = float(-projections[1][0, 3] / projections[1][0, 0])
        T_left_rectified = np.eye(4)
        T_left_rectified[:3, :3] = rotations[0].T
        self.T_body_camera = left.T_body_camera @ T_left_rectified
        self._maps = (
            ImageMap(lens_maps(left.lens, rotations[0], self.camera)),
            ImageMap(lens_maps(right.lens, rotations[1], self.camera)),
        )

    def left(self, rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the rectified left image, ``(h, w, 3)``; raises UsageError for another size."""
        self._check_size(0, rgb)
        return self._maps[0].colour(rgb)

    def right(self, gray: npt.NDArray[np.uint8]) -> StereoView:
        """Return the rectified right image of a grey one, ``(h, w)``; raises UsageError for another size."""
        self._check_size(1, gray)
        return StereoView(self._maps[1].colour(gray), self.baseline_m)

    def _check_size(self, which: int, image: npt.NDArray[np.uint8]) -> None:
        if image.shape[:2] != self._sizes[which]:
            height, width = self._sizes[which]
            raise UsageError(
                f"the {('left', 'right')[which]} image is {image.shape[1]}x{image.shape[0]} px, its camera "
                f"{width}x{height} px",
                hint="use the size that the rig was calibrated with",
            )


def _check_pair(left: RigCamera, right: RigCamera, right_in_left: Array) -> None:
    sizes = [(each.lens.camera.width, each.lens.camera.height) for each in (left, right)]
    if sizes[0] != sizes[1] or left.lens.model != right.lens.model:
        raise UsageError(
            f"the left camera is {left.lens.model}, {sizes[0][0]}x{sizes[0][1]} px, the right one "
            f"{right.lens.model}, {sizes[1][0]}x{sizes[1][1]} px",
            hint="a stereo pair needs two cameras of one size and model",
        )
    across, distance = float(right_in_left[0]), float(np.linalg.norm(right_in_left))
    if distance < _LEAST_BASELINE_M:
        raise UsageError(
            f"{right.name} sits {1e3 * distance:.2g} mm from {left.name}: that is no stereo pair",
            hint="check T_body_camera of both, in metres",
        )
    if abs(across) < 0.7 * distance:
        raise UsageError(
            f"{right.name} is not beside {left.name}, but {right_in_left.round(3).tolist()} m from it",
            hint="check T_body_camera of both: x of a camera points to the right",
        )
    if across < 0.0:
        raise UsageError(
            f"{right.name} sits {-across:.3g} m to the left of {left.name}: the cameras are swapped",
            hint="name the left camera first, or turn T_body_camera around (inverted?)",
        )


def _is_rectified(left: Intrinsics, right: Intrinsics, T_right_left: Array) -> bool:
    aside = T_right_left - np.eye(4)
    aside[0, 3] = 0.0
    same = left.camera == right.camera and not any(left.distortion) and not any(right.distortion)
    return same and left.model == "radial-tangential" and bool((np.abs(aside) < _RECTIFIED).all())


def _rectified(
    cv2: Any, left: Intrinsics, right: Intrinsics, T_right_left: Array
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return rotations ``(3, 3)`` from each camera to its rectified one, and both ``(3, 4)`` projections."""
    lenses = (
        left.camera.matrix, _coefficients(left), right.camera.matrix, _coefficients(right),
        (left.camera.width, left.camera.height), T_right_left[:3, :3], T_right_left[:3, 3],
    )  # fmt: skip
    if left.model == "fisheye":
        R1, R2, P1, P2, _ = cv2.fisheye.stereoRectify(*lenses, flags=cv2.CALIB_ZERO_DISPARITY, balance=0.0)
    else:
        R1, R2, P1, P2, _, _, _ = cv2.stereoRectify(*lenses, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0.0)
    return (R1, R2), (P1, P2)


def _pinhole(projection: Array, camera: Camera) -> Camera:
    try:
        return Camera(
            fx=float(projection[0, 0]), fy=float(projection[1, 1]),
            cx=float(projection[0, 2]), cy=float(projection[1, 2]),
            width=camera.width, height=camera.height,
        )  # fmt: skip
    except InvalidCamera as error:
        raise UsageError(
            f"the pair cannot be rectified: {error.message}", hint="check the distortion and T_body_camera"
        ) from error


def _coefficients(lens: Intrinsics) -> Array:
    return np.array(lens.distortion or (0.0, 0.0, 0.0, 0.0))
