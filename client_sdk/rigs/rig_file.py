"""Read and write ``rig.json``: the cameras and the IMU of a robot, with their poses on its body.

::

    {"cameras": [{"name": "left", "fx": 458.6, ..., "T_body_camera": [[...], [...], [...], [0, 0, 0, 1]]},
                 {"name": "right", ...}],
     "imu": {"T_body_imu": [[...]], "gyro_noise": 1.7e-4, "gyro_walk": 2e-5,
             "accel_noise": 2e-3, "accel_walk": 3e-3, "rate_hz": 200}}

A camera has the fields of ``intrinsics.json``, a name, its pose in the body (metres), and ``time_offset_s``
(`RigCamera`), which may be left out.  The IMU has the units of `client_sdk.imu.samples.ImuModel`; ``imu``,
``max_gyro`` and ``max_accel`` may be left out.  A camchain of Kalibr can be given instead of a ``rig.json``.
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

__all__ = ["read_calibration", "read_intrinsics", "read_rig", "write_rig"]

_HINT = "write cameras, each with name, fx fy cx cy width height and T_body_camera: see docs/cameras.md"
_CAMERA_FIELDS = ("name", "T_body_camera", "time_offset_s")  # fields of a camera that intrinsics.json has not
_IMU_FIELDS = ("gyro_noise", "gyro_walk", "accel_noise", "accel_walk", "rate_hz")  # numbers that an IMU needs
_IMU_RANGE_FIELDS = ("max_gyro", "max_accel")  # measuring ranges of an IMU; if left out, it does not saturate


def read_rig(path: Path | str) -> Rig:
    """Return the rig of ``rig.json``, or of a camchain of Kalibr (``.yaml``).

    Raises:
        UsageError: The file is missing, lacks a number, has an impossible number, or is an
            ``intrinsics.json``.
        MissingExtra: The file is YAML, and PyYAML is not installed.
    """
    calibration = read_calibration(path)
    if isinstance(calibration, Intrinsics):
        raise UsageError(f"{path} holds the intrinsics of one camera, and no rig", hint=_HINT)
    return calibration


def read_calibration(path: Path | str) -> Intrinsics | Rig:
    """Return the intrinsics of an ``intrinsics.json``, or the rig of a ``rig.json`` or a camchain of Kalibr.

    A file with the suffix ``.yaml`` or ``.yml`` is a camchain; a JSON object with the field ``cameras`` is a
    rig.

    Raises:
        UsageError: The file holds neither intrinsics nor a rig, or a number is missing or impossible.
        MissingExtra: The file is YAML, and PyYAML is not installed.
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
            cameras=tuple(_parse_camera(camera) for camera in values["cameras"]),
            imu=None if values.get("imu") is None else _parse_imu(values["imu"]),
        )


def read_intrinsics(path: Path | str) -> Intrinsics:
    """Return the intrinsics of a file that `read_calibration` reads; those of the left camera of a rig.

    Raises:
        UsageError: See `read_calibration`.
        MissingExtra: The file is YAML, and PyYAML is not installed.
    """
    calibration = read_calibration(path)
    return calibration.left.lens if isinstance(calibration, Rig) else calibration


def write_rig(path: Path | str, rig: Rig) -> None:
    """Write a ``rig.json`` that `read_rig` reads; raises UsageError if it cannot be written."""
    values: dict[str, Any] = {
        "cameras": [
            {
                "name": camera.name,
                **intrinsics_to_json(camera.lens),
                "T_body_camera": camera.T_body_camera.tolist(),
                "time_offset_s": camera.time_offset_s,
            }
            for camera in rig.cameras
        ]
    }
    if rig.imu is not None:
        ranges = {name: getattr(rig.imu, name) for name in _IMU_RANGE_FIELDS}
        values["imu"] = {
            "T_body_imu": rig.imu.T_body_imu.tolist(),
            **{name: getattr(rig.imu, name) for name in _IMU_FIELDS},
            **{name: value for name, value in ranges.items() if np.isfinite(value)},
        }
    write_json(path, values)


def _parse_camera(values: Any) -> RigCamera:
    return RigCamera(
        name=str(values["name"]),
        lens=parse_intrinsics({name: value for name, value in values.items() if name not in _CAMERA_FIELDS}),
        T_body_camera=_parse_pose(values["T_body_camera"]),
        time_offset_s=float(values.get("time_offset_s", 0.0)),
    )


def _parse_imu(values: Any) -> RigImu:
    ranges = {name: float(values[name]) for name in _IMU_RANGE_FIELDS if name in values}
    return RigImu(
        T_body_imu=_parse_pose(values["T_body_imu"]),
        **{name: float(values[name]) for name in _IMU_FIELDS},
        **ranges,
    )


def _parse_pose(rows: Any) -> Array:
    return np.array(rows, dtype=np.float64)
