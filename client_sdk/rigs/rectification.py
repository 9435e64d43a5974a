"""Rectify a stereo pair: resample both images as two equal pinhole cameras side by side would see them.

In rectified images, a point of the scene lies in the same row of both.  `client_sdk.stereo` matches along
rows.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from client_sdk.image_map import ImageMap
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig import RigCamera
from client_sdk.stereo.view import StereoView
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.geometry import Array, Camera, inverse, rectify_stereo_pair

__all__ = ["Rectification"]

# Smallest distance of the two cameras in metres: a smaller one means that a pose is missing, and the pair is
# refused.
_MIN_BASELINE_M = 0.001
_MIN_SIDEWAYS_SHARE = 0.7
"""Smallest absolute x of the right camera's position in the frame of the left camera, as a fraction of the
distance: with a smaller one the cameras are not side by side, but above or in front of each other, and the
pair is refused."""
_RECTIFIED_TOLERANCE = 1e-9
"""A pair whose lenses are equal pinholes counts as rectified already if no element of the ``(4, 4)`` pose
between its cameras deviates by this or more from a translation along x (no unit in the rotation, metres in
the translation)."""


class Rectification:
    """The rectified cameras of a stereo pair, and the lookup tables that resample its images.

    Images of a pair that is rectified already are returned as they are, not copied.

    Attributes:
        camera: The pinhole camera of both rectified images.
        baseline_m: Distance from the left camera to the right one, metres.
        T_body_camera: ``(4, 4)``, metres, pose of the rectified left camera in the body.  Its position is
            that of the left camera; its rotation differs from that of the left camera unless the pair is
            rectified already.

    Source:
        Bouguet's method, see `rse_pf.geometry.rectify_stereo_pair`.
    """

    def __init__(self, left: RigCamera, right: RigCamera) -> None:
        """Compute the rectified cameras and the lookup tables of both images.

        Raises:
            UsageError: The cameras are no stereo pair: they differ in image size or lens model, the right one
                is left of the left one, they are not side by side, or both are at one position.
            MissingExtra: OpenCV is not installed.
        """
        self._sizes = [(camera.lens.camera.height, camera.lens.camera.width) for camera in (left, right)]
        T_right_left = inverse(right.T_body_camera) @ left.T_body_camera
        _check_pair(left, right, inverse(T_right_left)[:3, 3])
        if _is_rectified(left.lens, right.lens, T_right_left):
            self.camera = left.lens.camera
            self.baseline_m = float(-T_right_left[0, 3])
            self.T_body_camera = left.T_body_camera
            self._maps = (ImageMap(None), ImageMap(None))
            return
        rotations, projections = rectify_stereo_pair(left.lens, right.lens, T_right_left)
        self.camera = _pinhole_camera(projections[0], left.lens.camera)
        self.baseline_m = float(-projections[1][0, 3] / projections[1][0, 0])
        T_left_rectified = np.eye(4)
        T_left_rectified[:3, :3] = rotations[0].T
        self.T_body_camera = left.T_body_camera @ T_left_rectified
        self._maps = (
            ImageMap(left.lens.undistortion_maps(self.camera, rotations[0])),
            ImageMap(right.lens.undistortion_maps(self.camera, rotations[1])),
        )

    def left(self, rgb: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the rectified image of a left colour image ``(h, w, 3)``.

        Raises:
            UsageError: The image does not have the size that the left camera was calibrated with.
        """
        self._check_size(0, rgb)
        return self._maps[0].colour(rgb)

    def right(self, gray: npt.NDArray[np.uint8]) -> StereoView:
        """Return the rectified image of a right grey image ``(h, w)``, together with the baseline.

        Raises:
            UsageError: The image does not have the size that the right camera was calibrated with.
        """
        self._check_size(1, gray)
        return StereoView(self._maps[1].colour(gray), self.baseline_m)

    def _check_size(self, side: int, image: npt.NDArray[np.uint8]) -> None:
        if image.shape[:2] != self._sizes[side]:
            height, width = self._sizes[side]
            raise UsageError(
                f"the {('left', 'right')[side]} image is {image.shape[1]}x{image.shape[0]} px, its camera "
                f"{width}x{height} px",
                hint="use the size that the rig was calibrated with",
            )


def _check_pair(left: RigCamera, right: RigCamera, right_in_left_m: Array) -> None:
    """Refuse two cameras that are no stereo pair.

    *right_in_left_m* ``(3,)`` is the position of the right camera in the frame of the left one, metres.

    Raises:
        UsageError: See `Rectification.__init__`.
    """
    sizes = [(camera.lens.camera.width, camera.lens.camera.height) for camera in (left, right)]
    if sizes[0] != sizes[1] or left.lens.model != right.lens.model:
        raise UsageError(
            f"the left camera is {left.lens.model}, {sizes[0][0]}x{sizes[0][1]} px, the right one "
            f"{right.lens.model}, {sizes[1][0]}x{sizes[1][1]} px",
            hint="a stereo pair needs two cameras of one size and model",
        )
    sideways_m, distance_m = float(right_in_left_m[0]), float(np.linalg.norm(right_in_left_m))
    if distance_m < _MIN_BASELINE_M:
        raise UsageError(
            f"{right.name} sits {1e3 * distance_m:.2g} mm from {left.name}: that is no stereo pair",
            hint="check T_body_camera of both, in metres",
        )
    if abs(sideways_m) < _MIN_SIDEWAYS_SHARE * distance_m:
        raise UsageError(
            f"{right.name} is not beside {left.name}, but {right_in_left_m.round(3).tolist()} m from it",
            hint="check T_body_camera of both: x of a camera points to the right",
        )
    if sideways_m < 0.0:
        raise UsageError(
            f"{right.name} sits {-sideways_m:.3g} m to the left of {left.name}: the cameras are swapped",
            hint="name the left camera first, or invert T_body_camera if it maps the body into the camera",
        )


def _is_rectified(left: Intrinsics, right: Intrinsics, T_right_left: Array) -> bool:
    """Return whether both lenses are one and the same pinhole, and the pose is a translation along x."""
    deviation = T_right_left - np.eye(4)
    deviation[0, 3] = 0.0
    are_equal_pinholes = left.camera == right.camera and left.is_pinhole and right.is_pinhole
    return are_equal_pinholes and bool((np.abs(deviation) < _RECTIFIED_TOLERANCE).all())


def _pinhole_camera(projection: Array, camera: Camera) -> Camera:
    """Return the pinhole camera of a ``(3, 4)`` projection matrix, with the image size of *camera*.

    Raises:
        UsageError: The rectified intrinsics cannot be those of a camera, because distortion or poses are
            wrong.
    """
    try:
        return Camera(
            fx=float(projection[0, 0]),
            fy=float(projection[1, 1]),
            cx=float(projection[0, 2]),
            cy=float(projection[1, 2]),
            width=camera.width,
            height=camera.height,
        )
    except InvalidCamera as error:
        raise UsageError(
            f"the pair cannot be rectified: {error.message}", hint="check the distortion and T_body_camera"
        ) from error
