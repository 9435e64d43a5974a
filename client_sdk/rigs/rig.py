"""A rig: the cameras and the IMU of a robot, and where they sit on its body.

It knows no file and no device; `client_sdk.rigs.rectification` makes a pair of its cameras ready for stereo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from client_sdk.imu.samples import ImuModel
from client_sdk.rigs.intrinsics import Intrinsics
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, rigid

__all__ = ["Rig", "RigCamera", "RigImu"]

_MAX_CAMERAS = 8
_MAX_ARM_M = 10.0
_MAX_OFFSET_S = 1.0
_MAX_NAME = 64


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigCamera:
    """A camera of a rig.

    Attributes:
        name: For people, such as ``left``.
        lens: Its intrinsics.
        T_body_camera: ``(4, 4)``, metres, pose of the camera in the body.
        time_offset_s: What must be added to the times of its images to get the clock of the rig, which is
            that of the IMU where there is one.

    Raises:
        UsageError: The pose is no rigid motion or is over 10 m long, or the offset is above 1 s.
    """

    name: str
    lens: Intrinsics
    T_body_camera: Array
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= len(self.name) <= _MAX_NAME or not self.name.isprintable():
            raise UsageError("the name of a camera is empty, or too long", hint="call it left or right")
        _set_pose(self, "T_body_camera", f"T_body_camera of the camera {self.name}")
        if not abs(self.time_offset_s) <= _MAX_OFFSET_S:
            raise UsageError(
                f"a time offset of {self.time_offset_s:g} s is not within {_MAX_OFFSET_S:g} s",
                hint="give seconds; Kalibr calls it timeshift_cam_imu",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigImu:
    """The IMU of a rig: ``T_body_imu`` ``(4, 4)``, metres; the other numbers are those of `ImuModel`.

    Raises:
        UsageError: A number is impossible.
    """

    T_body_imu: Array
    gyro_noise: float
    gyro_walk: float
    accel_noise: float
    accel_walk: float
    rate_hz: float
    max_gyro: float = math.inf
    max_accel: float = math.inf

    def __post_init__(self) -> None:
        _set_pose(self, "T_body_imu", "T_body_imu")
        self.model(self.T_body_imu)

    def model(self, T_body_camera: Array) -> ImuModel:
        """Return the model that frames of the camera at ``T_body_camera`` ``(4, 4)`` carry."""
        return ImuModel(
            T_imu_camera=inverse(self.T_body_imu) @ T_body_camera,
            gyro_noise=self.gyro_noise, gyro_walk=self.gyro_walk,
            accel_noise=self.accel_noise, accel_walk=self.accel_walk,
            rate_hz=self.rate_hz, max_gyro=self.max_gyro, max_accel=self.max_accel,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """One to eight cameras, the left one first and the right one second, and an IMU or None.

    Raises:
        UsageError: There is no camera, there are too many, or two have one name.
    """

    cameras: tuple[RigCamera, ...]
    imu: RigImu | None = None

    def __post_init__(self) -> None:
        if not 1 <= len(self.cameras) <= _MAX_CAMERAS:
            raise UsageError(
                f"{len(self.cameras)} cameras of a rig are not within 1..{_MAX_CAMERAS}",
                hint="give the left camera, and the right one where there is one",
            )
        names = [camera.name for camera in self.cameras]
        if len(set(names)) < len(names):
            raise UsageError(f"two cameras of {', '.join(names)} have one name", hint="rename one")

    @property
    def left(self) -> RigCamera:
        """The first camera."""
        return self.cameras[0]

    @property
    def right(self) -> RigCamera | None:
        """The second camera; None of a rig with one."""
        return self.cameras[1] if len(self.cameras) > 1 else None


def _set_pose(owner: object, field: str, name: str) -> None:
    """Replace a pose by its nearest rigid motion, or refuse it."""
    given = np.asarray(getattr(owner, field), dtype=np.float64)
    pose = rigid(given, _MAX_ARM_M) if given.shape == (4, 4) else None
    if pose is None:
        length = float(np.linalg.norm(given[:3, 3])) if given.shape == (4, 4) else 0.0
        unit = ": in millimetres?" if _MAX_ARM_M < length <= 1e3 * _MAX_ARM_M else ""
        raise UsageError(
            f"{name} is no rigid motion within {_MAX_ARM_M:g} m{unit}",
            hint="give 4 rows of 4 numbers: a rotation, metres, and 0 0 0 1",
        )
    object.__setattr__(owner, field, pose)
