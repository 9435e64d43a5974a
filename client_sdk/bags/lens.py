"""Read the lens of a camera from a ROS ``CameraInfo`` message, or from a file of intrinsics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.rigs.intrinsics import Intrinsics
from client_sdk.rigs.rig import Rig
from client_sdk.rigs.rig_file import read_calibration
from rse_pf.errors import InvalidCamera, UsageError
from rse_pf.geometry import LENS_MODELS, Array, Camera, Lens, find_lens_model

__all__ = ["lens_of", "lens_or_rig", "numbers_of"]

# Action for a camera without a usable calibration.
_HINT = "give the intrinsics yourself: --intrinsics intrinsics.json"


def lens_or_rig(file: Path) -> tuple[Lens | None, Rig | None]:
    """Read a file of intrinsics or of a rig; return (lens, None) or (None, rig) for `BagOptions`.

    Raises:
        UsageError: The file holds neither intrinsics nor a rig, or cannot be read.
    """
    own = read_calibration(file)
    return (own, None) if isinstance(own, Intrinsics) else (None, own)


def lens_of(message: Any, topic: str, *, is_rectified: bool) -> Lens:
    """Return the lens of a ``CameraInfo``: for rectified images from its matrix P, without distortion.

    The message states the intrinsics of the whole sensor.  The returned intrinsics belong to the image, which
    is the region of interest after binning (REP 104).

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
    coefficients = tuple(float(coefficient) for coefficient in D) if np.any(D) else ()
    model = find_lens_model(message.distortion_model) if coefficients else LENS_MODELS["radial-tangential"]
    if model is None:
        stated = str(message.distortion_model) or "(none)"
        raise UsageError(f"{topic} has a lens of the unknown model {stated}", hint=_HINT)
    try:
        camera = Camera(
            fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy),
            width=width, height=height,
        )  # fmt: skip
        return Lens(camera=camera, distortion=coefficients, model=model.name)
    except InvalidCamera as error:
        raise UsageError(f"{topic} holds no calibration: {error.message}", hint=_HINT) from error


def numbers_of(message: Any, name: str) -> Array:
    """Return the array ``d``, ``k``, ``r`` or ``p`` of a ``CameraInfo``, flat; ROS 1 has capital names."""
    return np.ravel(getattr(message, name if hasattr(message, name) else name.upper()))
