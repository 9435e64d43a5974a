"""Rigs as Kalibr writes them: ``camchain.yaml`` or ``camchain-imucam.yaml``, with the ``imu.yaml`` beside it.

The body is the IMU where the file says where that is, else the first camera.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from client_sdk.rigs.intrinsics import INTRINSICS_HINT, Intrinsics, name_file_in_errors, parse_lens_model
from client_sdk.rigs.rig import Rig, RigCamera, RigImu
from rse_pf.errors import MissingExtra, UsageError
from rse_pf.files import read_document
from rse_pf.geometry import Array, Camera, inverse

__all__ = ["read_kalibr"]

_MAX_BYTES = 1 << 18
_HINT = "name the camchain that kalibr_calibrate_cameras or kalibr_calibrate_imu_camera wrote"
_IMU_HINT = "it needs the noise densities and random walks of the IMU, and update_rate"
_MODELS = ("radtan", "none", "equidistant")
_NAMES = ("left", "right")
_IMU_FILES = ("imu.yaml", "imu0.yaml")


def read_kalibr(path: Path) -> Rig:
    """Return the cameras ``cam0``, ``cam1``, ... of a camchain, the first one called left, the second right.

    Raises:
        UsageError: The file is no camchain, has a lens model that is not known, or an impossible number.
        MissingExtra: PyYAML is not installed.
    """
    values = _read_yaml(path)
    with name_file_in_errors(path, _HINT):
        names = sorted(name for name in values if str(name).startswith("cam"))
        if not names or names[0] != "cam0":
            raise UsageError("there is no camera cam0", hint=INTRINSICS_HINT)
        cameras: list[RigCamera] = []
        for row, name in enumerate(names):
            each = values[name]
            with_imu = "T_cam_imu" in each
            if with_imu:
                pose = inverse(_pose(each["T_cam_imu"]))
            elif row:
                pose = cameras[-1].T_body_camera @ inverse(_pose(each["T_cn_cnm1"]))
            else:
                pose = np.eye(4)
            cameras.append(
                RigCamera(
                    name=_NAMES[row] if row < len(_NAMES) else str(name), lens=_lens(each),
                    T_body_camera=pose, time_offset_s=float(each.get("timeshift_cam_imu", 0.0)),
                )
            )  # fmt: skip
        has_imu = "T_cam_imu" in values["cam0"]
    return Rig(cameras=tuple(cameras), imu=_imu_beside(path) if has_imu else None)


def _lens(values: Any) -> Intrinsics:
    model, distortion = values["camera_model"], values.get("distortion_model", "none")
    if model != "pinhole" or distortion not in _MODELS:
        raise UsageError(
            f"a camera of model {model!s:.40} with distortion {distortion!s:.40} is not known",
            hint="calibrate with pinhole-radtan or pinhole-equi",
        )
    fx, fy, cx, cy = (float(value) for value in values["intrinsics"])
    width, height = values["resolution"]
    return Intrinsics(
        camera=Camera(fx=fx, fy=fy, cx=cx, cy=cy, width=int(width), height=int(height)),
        distortion=tuple(float(value) for value in values.get("distortion_coeffs", ())),
        model=parse_lens_model(distortion),
    )


def _imu_beside(path: Path) -> RigImu | None:
    """Return the IMU of the file that Kalibr leaves beside a camchain; None without one."""
    known = [path.with_name(path.name.replace("camchain-imucam", "imu").replace("camchain", "imu"))]
    known += [path.with_name(name) for name in _IMU_FILES]
    file = next((each for each in known if each != path and each.is_file()), None)
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


def _pose(rows: Any) -> Array:
    pose = np.array(rows, dtype=np.float64)
    if pose.shape != (4, 4):
        raise UsageError(f"a pose has the shape {pose.shape}", hint="it has 4 rows of 4 numbers")
    return pose


def _read_yaml(path: Path) -> Any:
    try:
        yaml: Any = importlib.import_module("yaml")
    except ImportError as error:
        raise MissingExtra("pyyaml", "vision") from error

    class LoaderWithoutAliases(yaml.SafeLoader):  # type: ignore[misc]  # PyYAML has no types
        """Refuses aliases: nested ones unfold to gigabytes wherever a value is used."""

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

    return read_document(
        path, "a camchain of Kalibr", hint=INTRINSICS_HINT, parse=parse, max_bytes=_MAX_BYTES
    )
