"""Read the two cameras of a stereo pair from their ``CameraInfo`` messages and from tf."""

from __future__ import annotations

from typing import Any

import numpy as np

from client_sdk.bags.lens import lens_of, numbers_of
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig import RigCamera
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, rigid

__all__ = ["CameraMessage", "pair_of"]

# Action for a stereo pair without a usable calibration.
_HINT = "give both cameras yourself: --intrinsics rig.json; or take one: --no-depth"
_MAX_COEFFICIENTS = 5
"""Largest number of distortion coefficients other than 0 of a camera in a stereo pair."""

# Largest distance, metres, between the cameras of a stereo pair; a larger one is refused, since its unit is
# probably wrong.
_MAX_BASELINE_M = 10.0

CameraMessage = tuple[str, Any, bool]
"""A camera of a bag: the name of its ``CameraInfo`` topic, the message, and whether its images are rectified
already."""


def pair_of(
    left: CameraMessage, right: CameraMessage, T_left_right: Array | None
) -> tuple[RigCamera, RigCamera]:
    """Return the left and the right camera of a rig whose body frame is that of the left camera.

    If the matrices P state a baseline, the pose of the right camera is computed from P and R as ROS defines
    them: ``P[3] = -f b`` for the baseline b, and R rotates a camera into its rectified one.  Otherwise it is
    *T_left_right*.

    Args:
        left: The left camera.
        right: The right camera.
        T_left_right: ``(4, 4)``, metres, pose of the right camera in the left one by tf; None if unknown.

    Raises:
        UsageError: A lens cannot be used, or the pose of the right camera is not known or too far away.
    """
    T_rectified = [_rectified_from(*each) for each in (left, right)]
    steps = [_baseline_of(name, message) for name, message, _ in (left, right)]
    aside = steps[0] - steps[1]
    if aside.any():
        T_rectified_right = np.eye(4)
        T_rectified_right[:2, 3] = aside
        T_left_right = inverse(T_rectified[0]) @ T_rectified_right @ T_rectified[1]
    elif T_left_right is None:
        raise UsageError(
            f"{right[0]} states a baseline of 0 (P[3]), and no tf_static joins the frames of both cameras: "
            "the pose of the right camera is not known",
            hint=_HINT,
        )
    distance_m = float(np.linalg.norm(T_left_right[:3, 3]))
    if distance_m > _MAX_BASELINE_M:
        raise UsageError(
            f"{right[0]} places the right camera {distance_m:.3g} m from the left one, above "
            f"{_MAX_BASELINE_M:g} m",
            hint="P[3] is -fx * baseline in metres; " + _HINT,
        )
    return (
        RigCamera(name="left", lens=_intrinsics(*left), T_body_camera=np.eye(4)),
        RigCamera(name="right", lens=_intrinsics(*right), T_body_camera=T_left_right),
    )


def _rectified_from(name: str, message: Any, is_rectified: bool) -> Array:
    """Return the rotation ``(4, 4)`` from the camera of the images to the rectified camera.

    The identity if the images are rectified already, or if the message states no R.
    """
    T = np.eye(4)
    R = numbers_of(message, "r").reshape(3, 3)
    if is_rectified or not np.any(R):
        return T
    T[:3, :3] = R
    turn = rigid(T)
    if turn is None:
        raise UsageError(f"R of {name} is no rotation", hint=_HINT)
    return turn


def _baseline_of(name: str, message: Any) -> Array:
    """Return the translation ``(2,)``, metres, that P of a camera states: ``P[3] / fx`` and ``P[7] / fy``.

    This translation maps points of the rectified left camera into this camera; it is 0 if P states no focal
    lengths.
    """
    P = numbers_of(message, "p")
    if not np.isfinite(P).all():
        raise UsageError(f"P of {name} holds a number that is not finite", hint=_HINT)
    if not (P[0] > 0.0 and P[5] > 0.0):
        return np.zeros(2)
    return np.array([P[3] / P[0], P[7] / P[5]])


def _intrinsics(name: str, message: Any, is_rectified: bool) -> Intrinsics:
    lens = lens_of(message, name, is_rectified=is_rectified)
    if any(lens.distortion[_MAX_COEFFICIENTS:]):
        raise UsageError(
            f"{name} has a lens of {len(lens.distortion)} distortion numbers, a pair takes "
            f"{_MAX_COEFFICIENTS}",
            hint=_HINT,
        )
    return Intrinsics(camera=lens.camera, distortion=lens.distortion[:_MAX_COEFFICIENTS], model=lens.model)
