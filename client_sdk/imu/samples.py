"""Samples of an inertial measurement unit (IMU), which belong to the frames of a robot, and the IMU's model.

Raw samples stay on the robot; it sends only the direction of gravity and the preintegrated motion of a
keyframe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rse_pf.errors import UsageError
from rse_pf.geometry import Array, rigid

__all__ = ["MAX_SAMPLES", "ImuModel", "ImuSamples", "check_samples"]

MAX_SAMPLES = 100_000
"""Most IMU samples that one frame may have: 20 seconds of an IMU at 5 kHz.  A frame with more is refused."""
# Smallest accepted rate of an IMU in Hz: below it the camera itself measures rotations more often.
_MIN_RATE_HZ = 10.0
_MAX_RATE_HZ = 10_000.0  # largest accepted rate of an IMU in Hz: a larger number is probably not in Hz
# Largest coordinate of the camera in the frame of the IMU, in metres: a larger number is refused, since it is
# probably not in metres.
_MAX_LEVER_ARM_M = 10.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuModel:
    """Mounting, noise and range of an IMU; the four noise densities are defined as in the files of Kalibr.

    Attributes:
        T_imu_camera: ``(4, 4)`` pose of the camera (of a stereo pair: the rectified left one) in the frame of
            the IMU, metres.
        gyro_noise: White noise of the gyroscope, rad/s/sqrt(Hz).
        gyro_walk: Random walk of the gyroscope's bias, rad/s^2/sqrt(Hz).
        accel_noise: White noise of the accelerometer, m/s^2/sqrt(Hz).
        accel_walk: Random walk of the accelerometer's bias, m/s^3/sqrt(Hz).
        rate_hz: Samples per second, 10 to 10,000.
        max_gyro: Rate at which the gyroscope saturates, rad/s.
        max_accel: Acceleration at which the accelerometer saturates, m/s^2.

    Raises:
        UsageError: *T_imu_camera* is not a rigid motion, its translation is above 10 m on an axis, or another
            number is outside its range.
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
        if np.shape(self.T_imu_camera) != (4, 4) or rigid(self.T_imu_camera, _MAX_LEVER_ARM_M) is None:
            raise UsageError(
                "T_imu_camera is no rigid motion within 10 m",
                hint="give the pose of the camera in the frame of the IMU, translation in metres",
            )
        for name in ("gyro_noise", "gyro_walk", "accel_noise", "accel_walk"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise UsageError(
                    f"{name} = {value:g} is not a finite number above 0",
                    hint="take the noise from the data sheet, or measure it with allan_variance_ros",
                )
        if not _MIN_RATE_HZ <= self.rate_hz <= _MAX_RATE_HZ:
            raise UsageError(
                f"rate_hz = {self.rate_hz:g} is not within {_MIN_RATE_HZ:g}..{_MAX_RATE_HZ:g} Hz",
                hint="give the samples per second",
            )
        for name in ("max_gyro", "max_accel"):
            if not getattr(self, name) > 0.0:
                raise UsageError(
                    f"{name} = {getattr(self, name):g} is not above 0",
                    hint="leave it out if the sensor does not saturate",
                )


@dataclass(frozen=True, slots=True, eq=False)
class ImuSamples:
    """IMU samples that belong to one frame: those since the frame before it.

    The first sample is at or before the previous frame and the last sample at or after this frame, as far as
    such samples exist, so that samples can be interpolated at both frames.

    Attributes:
        timestamps_s: ``(n,)``, strictly ascending, on the clock of the camera.  If they are off by a constant
            of up to 60 ms, for example an unknown offset between the clocks, `ImuEstimator` measures and
            corrects it.
        gyro: ``(n, 3)`` angular rates in the IMU's frame, rad/s.
        accel: ``(n, 3)`` specific forces in the IMU's frame, m/s^2: a stationary IMU measures 9.81 upwards.
        model: Model of the IMU.

    Raises:
        UsageError: The shapes do not fit, a number is not finite, times do not ascend, or there are more than
            100,000 samples.
    """

    timestamps_s: Array
    gyro: Array
    accel: Array
    model: ImuModel

    def __post_init__(self) -> None:
        count = check_samples(self.timestamps_s, self.gyro, self.accel)
        if count > MAX_SAMPLES:
            raise UsageError(
                f"{count} IMU samples of one frame are above {MAX_SAMPLES}",
                hint="give only the samples since the last frame",
            )

    def __len__(self) -> int:
        return len(self.timestamps_s)


def check_samples(timestamps_s: Array, gyro: Array, accel: Array) -> int:
    """Check the arrays of IMU samples, and return the number n of samples.

    Args:
        timestamps_s: ``(n,)``.
        gyro: ``(n, 3)`` rad/s.
        accel: ``(n, 3)`` m/s^2.

    Raises:
        UsageError: The shapes do not fit, a number is not finite, or times do not ascend.
    """
    n = len(timestamps_s)
    if timestamps_s.shape != (n,) or gyro.shape != (n, 3) or accel.shape != (n, 3):
        raise UsageError(
            f"IMU: times {timestamps_s.shape}, gyro {gyro.shape} and accel {accel.shape} do not fit",
            hint="give three rates and three accelerations for each time",
        )
    if not all(np.isfinite(array).all() for array in (timestamps_s, gyro, accel)):
        raise UsageError("an IMU sample is not finite", hint="leave out samples that were not measured")
    if not (np.diff(timestamps_s) > 0.0).all():
        raise UsageError("the times of the IMU do not ascend", hint="sort the samples, each time once")
    return n
