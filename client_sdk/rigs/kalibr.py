"""Read rigs of Kalibr: a camchain, and the file of the IMU in its folder.

A camchain is the file with the calibrated cameras that Kalibr writes, ``camchain-NAME.yaml`` for cameras
alone and ``camchain-imucam-NAME.yaml`` for cameras with an IMU.  The frame of the body is that of the IMU if
the camchain states ``T_cam_imu``, else that of the first camera.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.rigs.intrinsics import INTRINSICS_HINT, Intrinsics, name_file_in_errors, parse_lens_model
from client_sdk.rigs.rig import Rig, RigCamera, RigImu
from rse_pf.errors import MissingExtra, UsageError
from rse_pf.geometry import Array, Camera, inverse
from rse_pf.storage.files import read_document

__all__ = ["read_kalibr"]

_MAX_FILE_BYTES = 1 << 18
"""Largest file of Kalibr that is read, 256 KiB; a larger one is refused, and a camchain of eight cameras has
some kilobytes."""
_CAMCHAIN_HINT = "name the camchain that kalibr_calibrate_cameras or kalibr_calibrate_imu_camera wrote"
_IMU_HINT = "give the noise densities and random walks of the IMU, and update_rate, as imu.yaml has them"
_CAMERA_NAMES = ("left", "right")  # names of cam0 and cam1 in the rig; further cameras keep their names
_IMU_FILES = ("imu.yaml", "imu0.yaml")  # names that users give to the IMU's file, which Kalibr reads


def read_kalibr(path: Path) -> Rig:
    """Return the rig of the camchain *path*.

    The camera ``cam0`` is called left, and ``cam1`` right; further cameras keep their names.  The rig has an
    IMU if the camchain states ``T_cam_imu`` of ``cam0`` and its folder has a file of the IMU.

    Raises:
        UsageError: The file is no camchain, or has an unknown lens model or an impossible number.
        MissingExtra: PyYAML is not installed.
    """
    values = _read_yaml(path)
    with name_file_in_errors(path, _CAMCHAIN_HINT):
        names = sorted(name for name in values if str(name).startswith("cam"))
        if not names or names[0] != "cam0":
            raise UsageError("there is no camera cam0", hint=INTRINSICS_HINT)
        cameras: list[RigCamera] = []
        for number, name in enumerate(names):
            stated = values[name]
            if "T_cam_imu" in stated:
                T_body_camera = inverse(_parse_pose(stated["T_cam_imu"]))
            elif number:
                T_body_camera = cameras[-1].T_body_camera @ inverse(_parse_pose(stated["T_cn_cnm1"]))
            else:
                T_body_camera = np.eye(4)
            cameras.append(
                RigCamera(
                    name=_CAMERA_NAMES[number] if number < len(_CAMERA_NAMES) else str(name),
                    lens=_parse_lens(stated),
                    T_body_camera=T_body_camera,
                    time_offset_s=float(stated.get("timeshift_cam_imu", 0.0)),
                )
            )
        has_imu = "T_cam_imu" in values["cam0"]
    return Rig(cameras=tuple(cameras), imu=_read_imu_of_camchain(path) if has_imu else None)


def _parse_lens(stated: Any) -> Intrinsics:
    """Return the lens of a camera; *stated* are its fields in the camchain.

    Raises:
        UsageError: The projection is not pinhole, or the distortion model is not known.
    """
    projection, distortion_model = stated["camera_model"], stated.get("distortion_model", "none")
    if projection != "pinhole":
        raise UsageError(
            f"a camera of model {projection!s:.40} with distortion {distortion_model!s:.40} is not known",
            hint="calibrate with pinhole-radtan or pinhole-equi",
        )
    fx, fy, cx, cy = (float(value) for value in stated["intrinsics"])
    width, height = stated["resolution"]
    return Intrinsics(
        camera=Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=int(width), height=int(height)),
        distortion=tuple(float(value) for value in stated.get("distortion_coeffs", ())),
        model=parse_lens_model(distortion_model),
    )


def _read_imu_of_camchain(camchain: Path) -> RigImu | None:
    """Return the IMU of the file in the folder of *camchain*; None if there is no such file.

    Its name is the first that exists of ``imu-NAME.yaml`` (which Kalibr writes with ``camchain-NAME.yaml`` or
    ``camchain-imucam-NAME.yaml``), ``imu.yaml`` and ``imu0.yaml``.  ``T_body_imu`` is the identity, because
    the frame of the body is that of the IMU.

    Raises:
        UsageError: The file lacks a number, or a number is impossible.
    """
    name = camchain.name.replace("camchain-imucam", "imu").replace("camchain", "imu")
    candidates = [camchain.with_name(name), *(camchain.with_name(name) for name in _IMU_FILES)]
    file = next((path for path in candidates if path != camchain and path.is_file()), None)
    if file is None:
        return None
    values = _read_yaml(file)
    with name_file_in_errors(file, _IMU_HINT):
        values = values.get("imu0", values)
        return RigImu(
            T_body_imu=np.eye(4),
            gyro_noise=float(values["gyroscope_noise_density"]),
            gyro_walk=float(values["gyroscope_random_walk"]),
            accel_noise=float(values["accelerometer_noise_density"]),
            accel_walk=float(values["accelerometer_random_walk"]),
            rate_hz=float(values["update_rate"]),
        )


def _parse_pose(rows: Any) -> Array:
    pose = np.array(rows, dtype=np.float64)
    if pose.shape != (4, 4):
        raise UsageError(f"a pose has the shape {pose.shape}, not (4, 4)", hint="give 4 rows of 4 numbers")
    return pose


def _read_yaml(path: Path) -> dict[Any, Any]:
    """Return the mapping that a YAML file of Kalibr or OpenCV holds.

    Raises:
        UsageError: The file is missing, too large, no YAML mapping, or uses aliases.
        MissingExtra: PyYAML is not installed.
    """
    try:
        yaml: Any = importlib.import_module("yaml")
    except ImportError as error:
        raise MissingExtra("pyyaml", "vision") from error

    class LoaderWithoutAliases(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
        """A YAML loader that refuses aliases, because nested aliases unfold to gigabytes."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise ValueError("it has aliases (*NAME): write each value out")
            return super().compose_node(parent, index)

    def parse(text: str) -> Any:
        try:
            values = LoaderWithoutAliases(text.removeprefix("%YAML:1.0")).get_single_data()
        except yaml.YAMLError as error:
            raise ValueError("it is not YAML") from error
        if not isinstance(values, dict):
            raise ValueError("it names no camera")
        return values

    mapping: dict[Any, Any] = read_document(
        path, "a camchain of Kalibr", hint=INTRINSICS_HINT, parse=parse, max_bytes=_MAX_FILE_BYTES
    )
    return mapping
