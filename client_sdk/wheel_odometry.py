"""Use the wheel odometry of a robot during a drive: interpolate it, and state how uncertain it is.

`OdometryReading` is what a robot's base driver reports, such as a message of ``/odom``.  `WheelOdometry`
keeps the newest readings, and returns the motion of base and camera between two times.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from client_sdk.wheel_check import WheelCheck
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, inverse, orthonormalise, planar_pose, rigid, rotation_angle_deg, skew

__all__ = ["BaseCovariance", "OdometryReading", "WheelMotion", "WheelOdometry"]

_MAX_EXTRAPOLATION_S = 0.1
"""Longest time after the newest reading, in seconds, for which its velocity is assumed to continue: a robot
that brakes at 3 m/s^2 is then 1.5 cm from there."""
_SAME_TIME_S = 1e-6  # a reading is that of a frame if their times differ by at most this, in seconds
_MAX_GAP_S = 1.0
"""Longest time between two readings, in seconds, between which a pose is interpolated: in a longer one the
robot may have turned and come back."""
_MAX_READINGS = 16_384
"""Number of newest readings that are always kept: 2.7 minutes at 100 Hz; bounds memory to 5 MB."""
_LENGTH_DEVIATION = 0.05
"""Standard deviation of a motion by wheels, as a share of its length: slip, and a wrong radius."""
_TURN_DEVIATION = 0.05
"""Standard deviation of a rotation by wheels, as a share of the angle: slip, and a wrong track."""
_HEADING_DEVIATION_RAD_M = 0.025
"""Standard deviation of the heading that a straight motion by wheels adds, in rad per metre: two wheels that
are 0.4 m apart and differ by 1 %."""
_DRIFT_SHARE = 0.01
"""Standard deviation of the position by visual odometry, as a share of the distance since the last
correction: the trackers drift by 0.3 to 1 % on recorded drives."""
_ONE_LENS_DRIFT_SHARE = 0.05
"""The same for one lens, whose scale drifts: 5 to 7 % on a rendered drive of 5 m."""
_DRIFT_RAD = math.radians(0.3)
"""Standard deviation of the rotation by visual odometry after one metre, in rad; it grows with the root of
the distance since the last correction."""
_CLEAR_MOTION_M = 0.01  # a camera that moved by this length, in metres, does not take the same image again
_CLEAR_MOTION_RAD = 0.01  # a camera that turned by this angle, in rad, does not take the same image again
_STILL_M = 0.1  # a camera that moved by less, in metres, still sees most of what it saw
_STILL_RAD = 0.1  # a camera that turned by less, in rad, still sees most of what it saw
_MIN_STEP_M = 0.02
"""Shortest step, in metres, that counts for the distance of a tracked camera: the noise of the poses of a
stationary one is below it."""
_MIN_DEVIATION_M = (
    0.005  # smallest standard deviation of a position, metres: that of a mount measured by hand
)
_MIN_DEVIATION_RAD = 0.002  # smallest standard deviation of a rotation, rad, for the same reason


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OdometryReading:
    """One reading of a robot's wheel odometry.

    Attributes:
        timestamp_s: Time of the reading in seconds, by the clock of the camera.
        T_odom_base: ``(4, 4)``, metres: pose of the base in any fixed frame; x of the base is ahead, z up.

    Raises:
        UsageError: The time is not finite, or the pose is no rigid motion.
    """

    timestamp_s: float
    T_odom_base: Array

    def __post_init__(self) -> None:
        pose = rigid(np.asarray(self.T_odom_base, dtype=np.float64))
        if pose is None:
            raise UsageError(
                "T_odom_base is no pose", hint="give a (4, 4) matrix: a rotation, metres, and 0 0 0 1"
            )
        if not math.isfinite(self.timestamp_s):
            raise UsageError(
                f"timestamp_s = {self.timestamp_s:g} of a reading is not finite", hint="give seconds"
            )
        object.__setattr__(self, "T_odom_base", pose)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WheelMotion:
    """Motion of the base between two times by its wheels.

    Attributes:
        T_begin_end: ``(4, 4)``, metres: pose of the base at the end in its frame at the begin.
        T_camera_begin_end: ``(4, 4)``, metres: the same of the camera.
        length_m: Length of the path, metres.
        angle_rad: Sum of all rotations on the path, rad.
    """

    T_begin_end: Array
    T_camera_begin_end: Array
    length_m: float
    angle_rad: float

    @property
    def is_clear(self) -> bool:
        """Whether the base has moved: an image must have changed."""
        return self.length_m >= _CLEAR_MOTION_M or self.angle_rad >= _CLEAR_MOTION_RAD

    @property
    def is_still(self) -> bool:
        """Whether the camera still sees most of what it saw at the begin."""
        return self.length_m < _STILL_M and self.angle_rad < _STILL_RAD

    @property
    def reach_m(self) -> float:
        """Largest plausible error of the position, metres: three standard deviations."""
        return 3.0 * self.deviation_m

    @property
    def heading_deviation_rad(self) -> float:
        """Standard deviation of the rotation, rad."""
        return _HEADING_DEVIATION_RAD_M * self.length_m + _TURN_DEVIATION * self.angle_rad

    @property
    def deviation_m(self) -> float:
        """Standard deviation of the position, metres: of the length, and of the heading on the way."""
        return math.hypot(_LENGTH_DEVIATION, 0.5 * self.heading_deviation_rad) * self.length_m


class WheelOdometry:
    """The newest readings of one robot's wheel odometry.

    Attributes:
        T_base_camera: ``(4, 4)``, metres: mount of the camera on the base.
        is_planar: Whether the base stays in the plane z = 0 of the world.
    """

    def __init__(self, T_base_camera: Array) -> None:
        """Begin without readings.

        Raises:
            UsageError: *T_base_camera* is no pose.
        """
        mount = rigid(np.asarray(T_base_camera, dtype=np.float64))
        if mount is None:
            raise UsageError(
                "T_base_camera is no pose", hint="give a (4, 4) matrix: a rotation, metres, and 0 0 0 1"
            )
        self.T_base_camera: Array = mount
        self.is_planar = False
        self._check = WheelCheck()
        self._T_camera_base = inverse(mount)
        self._count = 0
        self._stamps_s: Array = np.empty(2 * _MAX_READINGS)
        self._poses: Array = np.empty((2 * _MAX_READINGS, 4, 4))
        self._paths: Array = np.zeros((3, 2 * _MAX_READINGS))
        """Length in metres, sum of rotations in rad, and heading in rad without wrap, up to each reading."""

    @property
    def trouble(self) -> str:
        """Why the readings are not used, as one sentence; empty while they are used."""
        return self._check.trouble

    def check(self, readings: Sequence[OdometryReading]) -> None:
        """Refuse readings that go back in time, also against those that were added before.

        Raises:
            UsageError: A reading is earlier than the one before it.
        """
        last_s = self._stamps_s[self._count - 1] if self._count else -math.inf
        for reading in readings:
            if reading.timestamp_s < last_s:
                raise UsageError(
                    f"a reading of odometry of {reading.timestamp_s:.6f} s is earlier than the one before, "
                    f"of {last_s:.6f} s",
                    hint="give each reading once, in the order of time",
                )
            last_s = reading.timestamp_s

    def add(self, readings: Sequence[OdometryReading]) -> None:
        """Add the readings since the last call, in the order of time; one of an equal time is ignored."""
        for reading in readings:
            n = self._count
            if n and reading.timestamp_s == self._stamps_s[n - 1]:
                continue
            if n == 2 * _MAX_READINGS:
                for table in (self._stamps_s, self._poses, *self._paths):
                    table[:_MAX_READINGS] = table[_MAX_READINGS:]
                n = _MAX_READINGS
            if n:
                last, new = self._poses[n - 1], reading.T_odom_base
                way_m, R_last_new = new[:3, 3] - last[:3, 3], last[:3, :3].T @ new[:3, :3]
                angle_rad = math.radians(rotation_angle_deg(R_last_new))
                yaw_rad = math.atan2(R_last_new[1, 0], R_last_new[0, 0])
                self._paths[:, n] = self._paths[:, n - 1]
                self._paths[:, n] += math.sqrt(way_m @ way_m), angle_rad, yaw_rad
            self._stamps_s[n], self._poses[n] = reading.timestamp_s, reading.T_odom_base
            self._count = n + 1

    def clear(self) -> None:
        """Forget all readings, such as before a clock that starts again."""
        self._count = 0

    def pose(self, timestamp_s: float) -> Array | None:
        """Return ``T_odom_base`` ``(4, 4)`` at a time, between two readings or at most 0.1 s beside them.

        None if the readings do not tell it: there are fewer than two, they end too early, or leave a gap of
        more than a second.
        """
        n = self._count
        if n < 2:
            return None
        after = min(max(int(np.searchsorted(self._stamps_s[:n], timestamp_s)), 1), n - 1)
        begin_s, end_s = self._stamps_s[after - 1], self._stamps_s[after]
        is_outside = not begin_s - _MAX_EXTRAPOLATION_S <= timestamp_s <= end_s + _MAX_EXTRAPOLATION_S
        if is_outside or (end_s - begin_s > _MAX_GAP_S and timestamp_s not in (begin_s, end_s)):
            return None
        for row, known_s in ((after, end_s), (after - 1, begin_s)):
            if abs(timestamp_s - known_s) <= _SAME_TIME_S:
                known: Array = self._poses[row].copy()
                return known
        # Between two readings the robot turns little: a matrix in between is nearly a rotation.
        share = (timestamp_s - begin_s) / (end_s - begin_s)
        return orthonormalise((1.0 - share) * self._poses[after - 1] + share * self._poses[after])

    def motion(self, begin_s: float, end_s: float) -> WheelMotion | None:
        """Return the motion of the base between two times; None if the readings do not tell it.

        None, too, while the readings have `trouble`.
        """
        return None if self.trouble else self._measure(begin_s, end_s)

    def _measure(self, begin_s: float, end_s: float) -> WheelMotion | None:
        """Return the motion of the base between two times, also while there is `trouble`."""
        begin, end = self.pose(begin_s), self.pose(end_s)
        if begin is None or end is None:
            return None
        T_begin_end = inverse(begin) @ end
        stamps_s, paths = self._stamps_s[: self._count], self._paths[:2, : self._count]
        (begin_m, end_m), (begin_rad, end_rad) = (
            np.interp((begin_s, end_s), stamps_s, path).tolist() for path in paths
        )
        return WheelMotion(
            T_begin_end=T_begin_end,
            T_camera_begin_end=self._T_camera_base @ T_begin_end @ self.T_base_camera,
            length_m=max(end_m - begin_m, float(np.linalg.norm(T_begin_end[:3, 3]))),
            angle_rad=max(end_rad - begin_rad, math.radians(rotation_angle_deg(T_begin_end[:3, :3]))),
        )

    def compare(self, timestamp_s: float, T_world_base: Array, world: object) -> None:
        """Compare the wheels with the tracked pose ``(4, 4)`` of a frame, in metres; sets `trouble`.

        Poses of different *world* are not compared, such as those of two segments.
        """
        check = self._check
        if not check.add(timestamp_s, T_world_base, world):
            return
        motion = self._measure(*check.window_s)
        headings = self._stamps_s[: self._count], self._paths[2, : self._count]
        check.close(None if motion is None else motion.T_begin_end, *headings)

    def camera_position(self, timestamp_s: float) -> Array | None:
        """Return the ``(3,)`` position of the camera in the frame of the readings; None if unknown."""
        pose = None if self.trouble else self.pose(timestamp_s)
        return None if pose is None else (pose @ self.T_base_camera)[:3, 3]

    def base_pose(self, T_world_camera: Array) -> Array:
        """Return ``T_world_base`` ``(4, 4)`` of a pose of the camera, in metres."""
        T_world_base: Array = T_world_camera @ self._T_camera_base
        return T_world_base

    def on_plane(self, T_world_camera: Array) -> Array:
        """Return the pose ``(4, 4)`` of the camera, metres, whose base is in the plane if it stays in one."""
        if not self.is_planar:
            return T_world_camera
        base = self.base_pose(T_world_camera)
        yaw_rad = math.atan2(base[1, 0], base[0, 0])
        pose: Array = planar_pose(base[0, 3], base[1, 3], yaw_rad) @ self.T_base_camera
        return pose


class BaseCovariance:
    """Covariance of the pose of a base in the world, frame by frame, with the drift since a correction.

    A covariance is ``(6, 6)``: of the position (m) and of the rotation (rad), both about the axes of the
    world.
    """

    def __init__(self) -> None:
        """Begin with a pose that is certain."""
        self._drift_share = _DRIFT_SHARE
        self._begin: Array = np.zeros((6, 6))
        self._before: Array = np.zeros((6, 6))
        self._begin_position: Array | None = None
        self._counted_position: Array = np.zeros(3)
        self._distance_m = 0.0
        self._last: Array = np.zeros((6, 6))
        self._last_position: Array = np.zeros(3)

    def expect_one_lens(self) -> None:
        """Expect the drift of a camera without depth."""
        self._drift_share = _ONE_LENS_DRIFT_SHARE

    def correct(self) -> None:
        """Begin anew with the covariance before the present segment: a recognised place removes its drift."""
        self._begin, self._begin_position = self._before, None

    def begin(self, T_world_base: Array, motion: WheelMotion | None) -> None:
        """Begin anew with the first pose ``(4, 4)`` of a segment, to which *motion* has carried the last one.

        Without a motion the segment has a world of its own, in which its first pose is certain.
        """
        self._before = self._last
        self._begin = np.zeros((6, 6)) if motion is None else self.carried(T_world_base, motion)
        self._begin_position = None

    def add_visual(self, T_world_base: Array, T_world_camera: Array, of_answer: Array | None) -> Array:
        """Return the covariance of a tracked pose.

        Args:
            T_world_base: ``(4, 4)``, metres.
            T_world_camera: ``(4, 4)``, metres, of the same frame.
            of_answer: ``(6, 6)``, see `TrackedFrame.covariance`; None without an answer.
        """
        position = T_world_base[:3, 3]
        # 1. Add the step to the distance since the last correction.
        if self._begin_position is None:
            self._begin_position = self._counted_position = position
            self._distance_m = 0.0
        step_m = float(np.linalg.norm(position - self._counted_position))
        if step_m >= _MIN_STEP_M:
            self._distance_m, self._counted_position = self._distance_m + step_m, position
        # 2. Carry the covariance of the begin to here, and add the drift.
        covariance = _moved(self._begin, position - self._begin_position)
        variance_m2 = _MIN_DEVIATION_M**2 + (self._drift_share * self._distance_m) ** 2
        variance_rad2 = _MIN_DEVIATION_RAD**2 + _DRIFT_RAD**2 * self._distance_m
        covariance[np.diag_indices(6)] += np.repeat((variance_m2, variance_rad2), 3)
        # 3. Add the covariance of the frame, which is that of a twist in the frame of the camera.
        if of_answer is not None:
            rotation = np.zeros((6, 6))
            rotation[:3, :3] = rotation[3:, 3:] = T_world_camera[:3, :3]
            own = rotation @ of_answer @ rotation.T
            covariance += _moved(own, position - T_world_camera[:3, 3])
        self._last, self._last_position = covariance, position
        return covariance

    def carried(self, T_world_base: Array, motion: WheelMotion) -> Array:
        """Return the covariance of a pose that *motion* has carried from the last tracked pose to here."""
        covariance = _moved(self._last, T_world_base[:3, 3] - self._last_position)
        variances = motion.deviation_m**2, motion.heading_deviation_rad**2
        covariance[np.diag_indices(6)] += np.repeat(variances, 3)
        return covariance


def _moved(covariance: Array, by_m: Array) -> Array:
    """Return the covariance of a pose at another point, ``(3,)`` metres away, of the same rigid body."""
    F = np.eye(6)
    F[:3, 3:] = -skew(by_m)
    moved: Array = F @ covariance @ F.T
    return moved
