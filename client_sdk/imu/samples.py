"""Samples of an inertial measurement unit, as they travel with the frames of a robot.

Nothing here leaves the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.geometry import Array, rigid

__all__ = ["MAX_SAMPLES", "ImuModel", "ImuSamples", "check_samples"]

MAX_SAMPLES = 100_000
"""Of one frame: 20 seconds of an IMU of 5 kHz."""
_LEAST_HZ, _MOST_HZ = 10.0, 10_000.0
_MAX_ARM_M = 10.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuModel:
    """Where an IMU is mounted, and its noise, as Kalibr and EuRoC state it.

    Attributes:
        T_imu_camera: ``(4, 4)``, pose of the camera (rectified, left) in the frame of the IMU.
        gyro_noise: rad/s/sqrt(Hz), white noise of the gyroscope.
        gyro_walk: rad/s^2/sqrt(Hz), random walk of its bias.
        accel_noise: m/s^2/sqrt(Hz), white noise of the accelerometer.
        accel_walk: m/s^3/sqrt(Hz), random walk of its bias.
        rate_hz: Samples a second.
        max_gyro: rad/s, from which on the gyroscope is saturated.
        max_accel: m/s^2, from which on the accelerometer is saturated.

    Raises:
        UsageError: The pose is no rigid motion or is over 10 m long, or a number is not above 0.
    """

    T_imu_camera: Array
    gyro_noise: float
    gyro_walk: float
    accel_noise: float
    accel_walk: float
    rate_hz: float
    max_gyro: float = math.inf
    max_accel: float = math.inf

    def __post_init__(self) -> None:
        if np.shape(self.T_imu_camera) != (4, 4) or rigid(self.T_imu_camera, _MAX_ARM_M) is None:
            raise UsageError(
                "T_imu_camera is no rigid motion within 10 m",
                hint="give the pose of the camera in the frame of the IMU, metres",
            )
        for name in ("gyro_noise", "gyro_walk", "accel_noise", "accel_walk"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise UsageError(
                    f"{name} = {value:g} is not a finite number above 0",
                    hint="take the noise from the data sheet, or from allan_variance_ros",
                )
        if not _LEAST_HZ <= self.rate_hz <= _MOST_HZ:
            raise UsageError(
                f"an IMU of {self.rate_hz:g} Hz is not within {_LEAST_HZ:g}..{_MOST_HZ:g} Hz",
                hint="give the samples a second",
            )
        if not (self.max_gyro > 0.0 and self.max_accel > 0.0):
            raise UsageError(
                "max_gyro or max_accel is not above 0", hint="leave it out if the IMU does not saturate"
            )


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """What an IMU measured since the last frame, on the clock of the camera.

    There is one sample at or before the last frame, and one at or after this one, where they exist.

    Attributes:
        timestamps_s: ``(n,)``, ascending.
        gyro: ``(n, 3)`` rad/s, in the axes of the IMU.
        accel: ``(n, 3)`` m/s^2, in the same axes; at rest it points up with 9.81.
        model: Of the IMU.

    Raises:
        UsageError: The shapes do not fit, a number is not finite, times do not ascend, or there are too many.
    """

    timestamps_s: Array
    gyro: Array
    accel: Array
    model: ImuModel

    def __post_init__(self) -> None:
        n = check_samples(self.timestamps_s, self.gyro, self.accel)
        if n > MAX_SAMPLES:
            raise UsageError(
                f"{n} IMU samples of one frame are above {MAX_SAMPLES}",
                hint="give those since the last frame",
            )

    def __len__(self) -> int:
        return len(self.timestamps_s)


def check_samples(timestamps_s: Array, gyro: Array, accel: Array) -> int:
    """Return the number n of samples: ``(n,)`` seconds, ``(n, 3)`` rad/s and m/s^2.

    Raises:
        UsageError: The shapes do not fit, a number is not finite, or times do not ascend.
    """
    n = len(timestamps_s)
    if timestamps_s.shape != (n,) or gyro.shape != (n, 3) or accel.shape != (n, 3):
        raise UsageError(
            f"IMU: times {timestamps_s.shape}, gyro {gyro.shape} and accel {accel.shape} do not fit",
            hint="give three rates and three accelerations for each time",
        )
    if not all(np.isfinite(each).all() for each in (timestamps_s, gyro, accel)):
        raise UsageError("an IMU sample is not finite", hint="leave out samples that were not measured")
    if not (np.diff(timestamps_s) > 0.0).all():
        raise UsageError("the times of the IMU do not ascend", hint="sort the samples, each time once")
    return n
