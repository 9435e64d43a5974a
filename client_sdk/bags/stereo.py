"""The two cameras of a stereo pair in a bag, as their ``CameraInfo`` and tf describe them."""

from __future__ import annotations

from typing import Any

import numpy as np

from client_sdk.bags.lens import lens_of, numbers_of
from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig import RigCamera
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, rigid

__all__ = ["CameraMessage", "pair_of"]

_HINT = "give both cameras yourself: --intrinsics rig.json; or take one: --no-depth"
_MOST_NUMBERS = 5
"""Of the distortion of a lens of a rig."""

_MAX_BASELINE_M = 10.0

CameraMessage = tuple[str, Any, bool]
"""Name of the topic, its ``CameraInfo``, and whether the images are rectified already."""


def pair_of(
    left: CameraMessage, right: CameraMessage, T_left_right: Array | None
) -> tuple[RigCamera, RigCamera]:
    """Return both cameras; the body is the left one.

    Where P of both messages states a distance, P and R tell the place of the right camera, as ROS defines
    them: ``P[3] = -f b``, and R turns a camera into its rectified one.  Otherwise tf does.

    Args:
        left: Of the left camera.
        right: Of the right one.
        T_left_right: ``(4, 4)``, pose of the right camera's frame in the left one's; None if tf has none.

    Raises:
        UsageError: A lens cannot be used, or the place of the right camera is not known.
    """
    T_rectified = [_rectified_from(*each) for each in (left, right)]
    steps = [_step(name, message) for name, message, _ in (left, right)]
    aside = steps[0] - steps[1]
    if aside.any():
        T_rectified_right = np.eye(4)
        T_rectified_right[:2, 3] = aside
        T_left_right = inverse(T_rectified[0]) @ T_rectified_right @ T_rectified[1]
    elif T_left_right is None:
        raise UsageError(
            f"{right[0]} states a baseline of 0 (P[3]), and no tf_static joins the frames of both cameras: "
            "where the right camera sits is not known",
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
    """Return the ``(4, 4)`` turn from what images show, rectified or not, to the rectified camera."""
    T = np.eye(4)
    R = numbers_of(message, "r").reshape(3, 3)
    if is_rectified or not np.any(R):
        return T
    T[:3, :3] = R
    turn = rigid(T)
    if turn is None:
        raise UsageError(f"R of {name} is no rotation", hint=_HINT)
    return turn


def _step(name: str, message: Any) -> Array:
    """Return ``(2,)``, metres: what P of a camera adds to the points of the rectified left one."""
    P = numbers_of(message, "p")
    if not np.isfinite(P).all():
        raise UsageError(f"P of {name} holds a number that is not finite", hint=_HINT)
    if not (P[0] > 0.0 and P[5] > 0.0):
        return np.zeros(2)
    return np.array([P[3] / P[0], P[7] / P[5]])


def _intrinsics(name: str, message: Any, is_rectified: bool) -> Intrinsics:
    lens = lens_of(message, name, is_rectified=is_rectified)
    if any(lens.distortion[_MOST_NUMBERS:]):
        raise UsageError(
            f"{name} has a lens of {len(lens.distortion)} distortion numbers, a pair takes {_MOST_NUMBERS}",
            hint=_HINT,
        )
    return Intrinsics(camera=lens.camera, distortion=lens.distortion[:_MOST_NUMBERS], model=lens.model)
