"""The rig of a robot: its cameras and its IMU, and their poses on the body.

Files of rigs are read by `client_sdk.rigs.rig_file`; `client_sdk.rigs.rectification` rectifies a stereo pair.
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

# Most cameras of a rig, of which the first two are used; a longer list is refused, and probably is no rig.
_MAX_CAMERAS = 8
# Largest coordinate of a sensor in the body in metres; a larger number is refused, and probably millimetres.
_MAX_LEVER_ARM_M = 10.0
# Largest offset of a camera's clock in seconds; a larger number is refused, and probably in milliseconds.
_MAX_TIME_OFFSET_S = 1.0
_MAX_NAME_LENGTH = 64  # most characters of a camera's name, which errors repeat; a longer name is refused


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigCamera:
    """A camera of a rig: its lens, its pose on the body, and its clock.

    Attributes:
        name: Name of the camera in errors, such as ``left``.
        lens: Intrinsics of the camera.
        T_body_camera: ``(4, 4)``, metres, pose of the camera in the body.
        time_offset_s: Seconds to add to a time stamp of the camera to get the time on the clock of the rig;
            the clock of the rig is that of its IMU if it has one.

    Raises:
        UsageError: The name is empty or longer than 64 characters, the pose is no rigid motion or its
            translation is above 10 m on an axis, or the time offset is above 1 s.
    """

    name: str
    lens: Intrinsics
    T_body_camera: Array
    time_offset_s: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= len(self.name) <= _MAX_NAME_LENGTH or not self.name.isprintable():
            raise UsageError(
                f"the name of a camera has {len(self.name)} characters, not 1..{_MAX_NAME_LENGTH}, or some "
                "that cannot be printed",
                hint="call the cameras left and right",
            )
        _normalise_pose(self, "T_body_camera", f"T_body_camera of the camera {self.name}")
        if not abs(self.time_offset_s) <= _MAX_TIME_OFFSET_S:
            raise UsageError(
                f"the time offset {self.time_offset_s:g} s of {self.name} is not within "
                f"{_MAX_TIME_OFFSET_S:g} s",
                hint="give seconds; Kalibr calls the offset timeshift_cam_imu",
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigImu:
    """The IMU of a rig: its pose ``T_body_imu`` ``(4, 4)``, metres, in the body, its noise, rate and range.

    The other fields have the meaning and the units that they have in `client_sdk.imu.samples.ImuModel`.

    Raises:
        UsageError: The pose is no rigid motion within 10 m, or `ImuModel` refuses a number.
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
        _normalise_pose(self, "T_body_imu", "T_body_imu")
        self.model(self.T_body_imu)

    def model(self, T_body_camera: Array) -> ImuModel:
        """Return the model of the IMU with its pose relative to the camera that makes the frames.

        *T_body_camera* ``(4, 4)``, metres, is the pose of this camera in the body; for a stereo pair, that of
        the rectified left camera.
        """
        return ImuModel(
            T_imu_camera=inverse(self.T_body_imu) @ T_body_camera,
            gyro_noise=self.gyro_noise,
            gyro_walk=self.gyro_walk,
            accel_noise=self.accel_noise,
            accel_walk=self.accel_walk,
            rate_hz=self.rate_hz,
            max_gyro=self.max_gyro,
            max_accel=self.max_accel,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """The sensors of a robot: one to eight cameras, and an IMU or None.

    A rig of two cameras or more is a stereo rig: the first camera is the left one, the second the right one.

    Raises:
        UsageError: There is no camera, there are more than eight, or two cameras have the same name.
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
            raise UsageError(f"two of the cameras {', '.join(names)} have the same name", hint="rename one")

    @property
    def left(self) -> RigCamera:
        """The first camera: the left one of a stereo rig, or the only camera."""
        return self.cameras[0]

    @property
    def right(self) -> RigCamera | None:
        """The second camera: the right one of a stereo rig; None for a rig with one camera."""
        return self.cameras[1] if len(self.cameras) > 1 else None


def _normalise_pose(sensor: object, field: str, name: str) -> None:
    """Replace the attribute *field*, a pose, of the frozen dataclass *sensor* by the result of `rigid`.

    That removes the rounding errors of a rotation.  *name* is the name of the pose in the error.

    Raises:
        UsageError: The pose is no ``(4, 4)`` rigid motion within 10 m on each axis.
    """
    stated = np.asarray(getattr(sensor, field), dtype=np.float64)
    pose = rigid(stated, _MAX_LEVER_ARM_M) if stated.shape == (4, 4) else None
    if pose is None:
        length_m = float(np.linalg.norm(stated[:3, 3])) if stated.shape == (4, 4) else 0.0
        is_millimetres = _MAX_LEVER_ARM_M < length_m <= 1e3 * _MAX_LEVER_ARM_M
        raise UsageError(
            f"{name} is no rigid motion within {_MAX_LEVER_ARM_M:g} m"
            + (": in millimetres?" if is_millimetres else ""),
            hint="give 4 rows of 4 numbers: a rotation, metres, and 0 0 0 1",
        )
    object.__setattr__(sensor, field, pose)
