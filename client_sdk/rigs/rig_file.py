"""``rig.json``: the cameras and the IMU of a robot, as calibration writes it; and the files of others.

::

    {"cameras": [{"name": "left", "fx": 458.6, ..., "T_body_camera": [[...], [...], [...], [0, 0, 0, 1]]},
                 {"name": "right", ...}],
     "imu": {"T_body_imu": [[...]], "gyro_noise": 1.7e-4, "gyro_walk": 2e-5,
             "accel_noise": 2e-3, "accel_walk": 3e-3, "rate_hz": 200}}

A camera is what ``intrinsics.json`` holds, with a name, its pose in the body (metres), and ``time_offset_s``,
which may be left out.  ``imu`` may be left out, and so may ``max_gyro`` and ``max_accel``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.rigs.intrinsics import (
    INTRINSICS_HINT,
    Intrinsics,
    intrinsics_to_json,
    name_file_in_errors,
    parse_intrinsics,
    read_json,
    write_json,
)
from client_sdk.rigs.kalibr import read_kalibr
from client_sdk.rigs.rig import Rig, RigCamera, RigImu
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = ["read_calibration", "read_rig", "write_rig"]

_HINT = "it needs cameras, each with name, fx fy cx cy width height and T_body_camera: see docs/cameras.md"
_OF_RIG = ("name", "T_body_camera", "time_offset_s")
"""Fields of a camera beside those of its lens."""
_NOISE = ("gyro_noise", "gyro_walk", "accel_noise", "accel_walk", "rate_hz")
_LIMITS = ("max_gyro", "max_accel")


def read_rig(path: Path | str) -> Rig:
    """Return the rig of ``rig.json``, or of a camchain of Kalibr (``.yaml``).

    Raises:
        UsageError: The file is missing, or lacks a number, or a number is impossible.
        MissingExtra: PyYAML is needed and not installed.
    """
    found = read_calibration(path)
    if isinstance(found, Intrinsics):
        raise UsageError(f"{path} holds one camera, and not its place", hint=_HINT)
    return found


def read_calibration(path: Path | str) -> Intrinsics | Rig:
    """Return the intrinsics of ``intrinsics.json``, or the rig of a file that `read_rig` reads.

    Raises:
        UsageError: The file is neither.
        MissingExtra: PyYAML is needed and not installed.
    """
    path = Path(path)
    if path.suffix in (".yaml", ".yml"):
        return read_kalibr(path)
    values = read_json(path, INTRINSICS_HINT)
    if isinstance(values, dict) and "cameras" not in values:
        with name_file_in_errors(path, INTRINSICS_HINT):
            return parse_intrinsics(values)
    with name_file_in_errors(path, _HINT):
        return Rig(
            cameras=tuple(_camera(each) for each in values["cameras"]),
            imu=None if values.get("imu") is None else _imu(values["imu"]),
        )


def write_rig(path: Path | str, rig: Rig) -> None:
    """Write the file that `read_rig` reads; raises UsageError where it cannot be written."""
    values: dict[str, Any] = {
        "cameras": [
            {
                "name": each.name,
                **intrinsics_to_json(each.lens),
                "T_body_camera": each.T_body_camera.tolist(),
                "time_offset_s": each.time_offset_s,
            }
            for each in rig.cameras
        ]
    }
    if rig.imu is not None:
        limits = {name: getattr(rig.imu, name) for name in _LIMITS}
        values["imu"] = {
            "T_body_imu": rig.imu.T_body_imu.tolist(),
            **{name: getattr(rig.imu, name) for name in _NOISE},
            **{name: value for name, value in limits.items() if np.isfinite(value)},
        }
    write_json(path, values)


def _camera(values: Any) -> RigCamera:
    lens = {name: value for name, value in values.items() if name not in _OF_RIG}
    return RigCamera(
        name=str(values["name"]), lens=parse_intrinsics(lens), T_body_camera=_pose(values["T_body_camera"]),
        time_offset_s=float(values.get("time_offset_s", 0.0)),
    )  # fmt: skip


def _imu(values: Any) -> RigImu:
    limits = {name: float(values[name]) for name in _LIMITS if name in values}
    return RigImu(
        T_body_imu=_pose(values["T_body_imu"]), **{name: float(values[name]) for name in _NOISE}, **limits
    )


def _pose(rows: Any) -> Array:
    return np.array(rows, dtype=np.float64)
