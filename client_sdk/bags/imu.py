"""Read the samples of an IMU from the ``sensor_msgs/Imu`` messages of a bag, at most `_MAX_SAMPLES`."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np

from client_sdk.bags.bag_file import BrokenMessage
from client_sdk.imu.samples import MAX_SAMPLES
from client_sdk.rigs.imu_track import ImuTrack
from client_sdk.rigs.rig import Rig, RigImu
from rse_pf.errors import UsageError
from rse_pf.geometry import Array

__all__ = ["ImuMount", "ImuReadings", "imu_track", "numbers_of_imu"]

_MAX_SAMPLES = 2_000_000
"""Largest number of samples that are kept, 128 MB: almost three hours at 200 Hz."""
_USUAL_NOISE = {"gyro_noise": 1e-3, "gyro_walk": 1e-4, "accel_noise": 6e-3, "accel_walk": 3e-3}
"""Noise that is assumed for an IMU whose noise is not stated, a small MEMS IMU as in depth cameras: four
times the noise densities in the data sheet of Bosch's BMI055 (0.014 degree/s/sqrt(Hz), 150 ug/sqrt(Hz)),
because a robot shakes.  The random walk of the accelerations is that of EuRoC's IMU, the random walk of the
rates is five times that of EuRoC's.  Units are those of `RigImu`."""
# Action for an IMU that cannot be used.
_HINT = "leave the IMU out with --no-imu, or give its place and noise with --intrinsics rig.json"


class ImuReadings:
    """The samples of an IMU topic.

    ``frame`` is the frame of the first message; ``ignored`` counts samples beyond the largest number.
    """

    def __init__(self) -> None:
        self.frame = ""
        self.ignored = 0
        self._stamps_ns = array("q")
        self._log_ns = array("q")
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._stamps_ns)

    def add(self, message: Any, stamp_ns: int, log_ns: int) -> None:
        """Add the sample of a message with its stamp and time of writing, nanoseconds.

        Raises:
            BrokenMessage: The message lacks rates or accelerations, or a number is not finite.
        """
        numbers = numbers_of_imu(message)
        if len(self) >= _MAX_SAMPLES:
            self.ignored += 1
            return
        if not len(self):
            self.frame = str(message.header.frame_id)
        self._stamps_ns.append(stamp_ns)
        self._log_ns.append(log_ns)
        self._values.extend(numbers)

    def sorted(self, *, use_log_time: bool) -> tuple[Array, Array]:
        """Return ascending times ``(n,)``, s, and rates (rad/s) and accelerations (m/s^2) ``(n, 6)``.

        Of several samples with one time, the first is returned.  With *use_log_time* the times are those at
        which the messages were written to the bag, otherwise their time stamps.
        """
        stamps_ns = np.frombuffer(self._log_ns if use_log_time else self._stamps_ns, dtype=np.int64)
        unique, rows = np.unique(stamps_ns, return_index=True)
        return unique / 1e9, np.frombuffer(self._values).reshape(-1, 6)[rows]


def numbers_of_imu(message: Any) -> tuple[float, ...]:
    """Return the three rates and three accelerations of a ``sensor_msgs/Imu``, rad/s and m/s^2.

    Raises:
        BrokenMessage: The message states that it has no rates or accelerations, or a number is not finite.
    """
    if message.angular_velocity_covariance[0] == -1 or message.linear_acceleration_covariance[0] == -1:
        raise BrokenMessage("a message of an IMU has no rates, or no accelerations")
    gyro, accel = message.angular_velocity, message.linear_acceleration
    numbers = (gyro.x, gyro.y, gyro.z, accel.x, accel.y, accel.z)
    if not all(map(math.isfinite, numbers)):
        raise BrokenMessage("a sample of an IMU is not finite")
    return numbers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImuMount:
    """The poses of the IMU and of the camera of the frames.

    Attributes:
        T_left_camera: ``(4, 4)``, metres, pose of the camera of the frames, which may be rectified, in the
            colour or left camera of the bag.
        T_left_imu: ``(4, 4)``, metres, pose of the IMU in the colour or left camera; None if tf does not
            connect them.
        rig: The rig that the user gave, or None; its pose and noise of the IMU are used instead of tf and the
            assumed noise.
    """

    T_left_camera: Array
    T_left_imu: Array | None
    rig: Rig | None


def imu_track(
    readings: ImuReadings, topic: str, frames_s: Array, mount: ImuMount, *, use_log_time: bool
) -> tuple[ImuTrack, str]:
    """Return the samples of the IMU with its model, and a sentence about them for the user.

    Args:
        readings: The samples of the topic.
        topic: Name of the topic, for messages.
        frames_s: ``(n,)``, ascending times of the frames, s.
        mount: Poses of the IMU and of the camera.
        use_log_time: Whether times of writing are used instead of time stamps.

    Raises:
        UsageError: There are too few samples, none between the frames, too many between two frames, or the
            pose of the IMU is not known.
    """
    rig = mount.rig
    stamps_s, values = readings.sorted(use_log_time=use_log_time)
    if len(stamps_s) < 2:
        raise UsageError(f"{topic} has fewer than 2 samples that can be used", hint=_HINT)
    if rig is not None:
        stamps_s = stamps_s - rig.left.time_offset_s
    within = np.searchsorted(stamps_s, frames_s)
    if within[0] == within[-1]:
        raise UsageError(f"no sample of {topic} lies between the first and the last frame", hint=_HINT)
    most = int(np.diff(within).max())
    if most > MAX_SAMPLES // 2:
        raise UsageError(
            f"{topic} has {most} samples between two frames, more than {MAX_SAMPLES // 2}", hint=_HINT
        )
    noise, whose = _noise(topic, stamps_s, mount.T_left_imu, rig)
    T_body_left = np.eye(4) if rig is None else rig.left.T_body_camera
    model = noise.model(T_body_left @ mount.T_left_camera)
    track = ImuTrack(
        stamps_s, np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:]), model
    )
    left_out = f", {readings.ignored} more left out" if readings.ignored else ""
    return track, f"IMU: {topic}, {len(stamps_s)} samples, {model.rate_hz:.0f} Hz, {whose}{left_out}"


def _noise(topic: str, stamps_s: Array, T_left_imu: Array | None, rig: Rig | None) -> tuple[RigImu, str]:
    """Return pose and noise of the IMU, and a phrase on their source; a missing pose raises UsageError."""
    if rig is not None and rig.imu is not None:
        return rig.imu, "as the file of intrinsics states it"
    if T_left_imu is None:
        raise UsageError(
            f"no tf_static joins the frame of {topic} with that of the camera: the pose of the IMU is "
            "not known",
            hint=_HINT,
        )
    T_body_left = np.eye(4) if rig is None else rig.left.T_body_camera
    rate_hz = 1.0 / float(np.median(np.diff(stamps_s)))
    noise = RigImu(T_body_imu=T_body_left @ T_left_imu, rate_hz=rate_hz, **_USUAL_NOISE)
    return noise, "the noise of a small MEMS IMU is assumed"
