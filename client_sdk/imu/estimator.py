"""Use one IMU during a drive: check it, predict rotations between frames, and estimate gravity and scale."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from client_sdk.imu.alignment import GRAVITY_M_S2, ImuAlignment, align_imu
from client_sdk.imu.checks import check_rates, find_sample_trouble
from client_sdk.imu.history import ImuHistory
from client_sdk.imu.preintegration import Preintegration, preintegrate
from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_so3, log_so3
from rse_pf.slam.inertial import InertialMotion, KeyframeImu, upright_rotation

__all__ = ["ImuEstimator", "ImuScale", "level_start_pose"]

_POSE_STEP_S = 0.2  # smallest time between two successive poses that are aligned with the IMU
_MAX_POSES = 150  # most poses that are aligned with the IMU, the newest ones: those of the last 30 seconds
_MIN_POSES = 8  # fewest poses that are aligned with the IMU; with fewer, `align` has no result
_RETRY_S = 0.5  # time between two IMU alignments while gravity or scale is not known well enough
_REPEAT_S = 2.0  # time between two IMU alignments when both are known well enough; biases still change
_POSE_NOISE_PX = 0.33
"""Standard deviation of a tracked pose, as the shift of the image in pixels: of the rotation it is 0.33 / fx
rad, of the position 0.33 / fx times the median depth."""
# Largest standard deviation of a scale divided by the scale; above it the scale counts as unknown.
_MAX_SCALE_DEVIATION = 0.015
# Largest standard deviation of the direction of gravity; above it gravity counts as unknown.
_MAX_GRAVITY_DEVIATION_RAD = math.radians(0.5)
# Largest misfit (`ImuAlignment.misfit`) of an alignment that is used; it is 1 if the noise is as stated.  An
# alignment with a larger one is discarded.
_MAX_MISFIT = 12.0
_MAX_MISFITS_IN_A_ROW = 3
"""After this many successive alignments with a misfit above `_MAX_MISFIT` the IMU is not used any more
(`ImuEstimator.trouble`); the cause of fewer may be a wrong pose."""
_MAX_BIAS_CHANGE_RAD_S = 0.005
"""A cached motion is preintegrated again if an axis of the gyroscope's bias has changed by more than this
since."""
_MAX_CACHED_MOTIONS = 4 * _MAX_POSES
"""The cache of preintegrated motions is emptied when it has more than this many.  One alignment uses fewer
than `_MAX_POSES`, so this happens rarely."""
_RATE_CHECK_S = 20.0  # the rotations of the poses of this many last seconds are compared with the gyroscope
# Longest preintegrated motion that a keyframe contains, in seconds: a longer one is too uncertain, and the
# keyframe is sent without a motion.
_MAX_MOTION_S = 10.0
# Smallest standard deviation of gravity's direction that a keyframe states; it replaces a smaller estimate.
_MIN_GRAVITY_DEVIATION_RAD = 1e-3
_MAX_STATIONARY_ERROR = 0.25
"""Largest difference between the magnitude of the mean specific force and 9.81 m/s^2, as a fraction of the
latter, with which `stationary_gravity` returns a result."""
_R_WORLD_LEVEL_CAMERA: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation of a level camera (z ahead, y down) in a world with x ahead, y left, z up (ROS REP 103)."""


class ImuEstimator:
    """Estimate time offset, biases, gravity and scale with one IMU, as far as the motion determines them.

    Attributes:
        trouble: Why the IMU is not used, as a sentence; empty while it may be used.  Once it is set, it
            stays.
        offset_s: Time by which the clock of the IMU is ahead of that of the camera; 0 until `align` has
            measured an offset of more than 3 ms.
        alignment: Result of the last `align`; None before the first, if the last had no result, and after
            `forget_gravity`.
    """

    def __init__(self, model: ImuModel, camera: Camera) -> None:
        self.trouble = ""
        self.offset_s = 0.0
        self.alignment: ImuAlignment | None = None
        self._history = ImuHistory(model)
        self._camera = camera
        self._gyro_bias: Array = np.zeros(3)
        self._has_agreed = False  # whether `check_rates` has compared the rates once and found no fault
        self._due_s = float("-inf")
        self._misfits_in_a_row = 0
        self._motions: dict[tuple[float, float], Preintegration] = {}

    def add(self, samples: ImuSamples) -> None:
        """Add the samples of a frame."""
        self._history.add(samples)

    def camera_rotation(self, begin_s: float, end_s: float) -> Array | None:
        """Integrate the gyroscope between two times of the camera's clock.

        Returns:
            ``R_begin_end`` ``(3, 3)``, which maps vectors from the camera's frame at the end to its frame at
            the begin.  None if samples are missing, before an `align` has compared the gyroscope with the
            camera's rotations and found no fault, and when ``trouble`` is set.
        """
        if not self._has_agreed or self.trouble:
            return None
        samples = self._history.between(begin_s, end_s, self.offset_s)
        if samples is None:
            return None
        rates = 0.5 * (samples.gyro[1:] + samples.gyro[:-1]) - self._gyro_bias
        R_begin_end = np.eye(3)
        for step in exp_so3(rates * np.diff(samples.timestamps_s)[:, None]):
            R_begin_end = R_begin_end @ step
        R_imu_camera = self._history.model.T_imu_camera[:3, :3]
        camera_rotation: Array = R_imu_camera.T @ R_begin_end @ R_imu_camera
        return camera_rotation

    def forget_gravity(self) -> None:
        """Discard the alignment, because the next poses are in another world; `align` is due at once.

        The gyroscope's bias and the time offset stay.
        """
        self.alignment, self._due_s = None, float("-inf")

    def is_due(self, timestamp_s: float) -> bool:
        """Return whether `align` should run at the frame of *timestamp_s*; False when ``trouble`` is set."""
        return not self.trouble and timestamp_s >= self._due_s

    def align(
        self, timestamps_s: Array, T_world_camera: Array, depth: float, *, is_metric: bool
    ) -> ImuAlignment | None:
        """Align the IMU with the newest tracked poses.

        Args:
            timestamps_s: ``(n,)`` time stamps of all poses of one world, ascending; n may be 0.
            T_world_camera: ``(n, 4, 4)`` poses of the camera.
            depth: Median depth of the scene in the unit of the poses; the noise of positions is proportional.
            is_metric: Whether the unit of the poses is the metre.

        Returns:
            The alignment.  None if the poses do not determine it, if its misfit is too large to use it, or if
            the IMU has a fault, which ``trouble`` then states.
        """
        self.alignment = None
        if not len(timestamps_s) or self.trouble:
            return None
        self._due_s = float(timestamps_s[-1]) + _RETRY_S
        # 1. Check the samples and the gyroscope, and end if the IMU may not be used (yet); measure the time
        #    offset and a first gyroscope bias.
        if not self._check(timestamps_s, T_world_camera):
            return None
        # 2. Choose poses 0.2 s apart, and preintegrate the motions between them.
        rows, motions = self._covered_by_samples(timestamps_s, _spaced_rows(timestamps_s)[-_MAX_POSES:])
        if len(rows) < _MIN_POSES:
            return None
        # 3. Align the IMU with these poses, whose noise is a third of a pixel.
        noise_rad = _POSE_NOISE_PX / self._camera.fx
        pose_noise = noise_rad, noise_rad * depth
        try:
            alignment = align_imu(
                T_world_camera[rows], motions, self._history.model, pose_noise, is_metric=is_metric
            )
        except UsageError as error:
            self.trouble = error.message
            return None
        if alignment is None:
            return None
        # 4. Discard an alignment with a large misfit; after three in a row the IMU is not used any more.
        self._misfits_in_a_row = self._misfits_in_a_row + 1 if alignment.misfit > _MAX_MISFIT else 0
        if self._misfits_in_a_row >= _MAX_MISFITS_IN_A_ROW:
            self.trouble = (
                f"the accelerometer does not agree with the camera: {alignment.misfit:.1f} deviations apart; "
                "are its axes, its unit and its noise right?"
            )
        if self._misfits_in_a_row:
            return None
        # 5. Store the alignment and its gyroscope bias; wait longer if gravity and scale are known.
        self._gyro_bias = alignment.gyro_bias_rad_s
        self.alignment = alignment
        is_gravity_known = alignment.gravity_deviation_rad <= _MAX_GRAVITY_DEVIATION_RAD
        if is_gravity_known and alignment.scale_deviation <= _MAX_SCALE_DEVIATION:
            self._due_s = float(timestamps_s[-1]) + _REPEAT_S
        return alignment

    @property
    def gravity_m_s2(self) -> Array | None:
        """Gravity ``(3,)``, m/s^2, in the world of the last aligned poses.

        None without an alignment, or if the standard deviation of its direction is above 0.5 degrees.
        """
        alignment = self.alignment
        if alignment is None or alignment.gravity_deviation_rad > _MAX_GRAVITY_DEVIATION_RAD:
            return None
        return alignment.gravity_m_s2

    def stationary_gravity(self) -> Array | None:
        """Return gravity ``(3,)`` in the camera's frame, m/s^2: the negative mean specific force so far.

        It is right only if the camera was stationary.  None if the magnitude of the mean specific force is
        not within 25 % of 9.81 m/s^2: the camera has moved, or the unit is not m/s^2.
        """
        accel = self._history.mean_accel()
        if accel is None or abs(float(np.linalg.norm(accel)) / GRAVITY_M_S2 - 1.0) > _MAX_STATIONARY_ERROR:
            return None
        gravity_camera: Array = -(self._history.model.T_imu_camera[:3, :3].T @ accel)
        return gravity_camera

    def keyframe_imu(
        self, T_world_camera: Array, previous_s: float | None, timestamp_s: float
    ) -> KeyframeImu | None:
        """Return the direction of gravity at a keyframe, and the preintegrated motion since the previous one.

        Args:
            T_world_camera: ``(4, 4)`` pose of the keyframe in the world of the last alignment.
            previous_s: Time stamp of the previous keyframe of the segment; None if there is none.
            timestamp_s: Time stamp of the keyframe.

        Returns:
            None while gravity is not known.  Otherwise the direction of gravity, and the motion if there is a
            previous keyframe, no samples are missing, and at most 10 s have passed.
        """
        gravity = self.gravity_m_s2
        if gravity is None or self.alignment is None or self.trouble:
            return None
        down = T_world_camera[:3, :3].T @ gravity
        samples = (
            None if previous_s is None else self._history.between(previous_s, timestamp_s, self.offset_s)
        )
        motion = None
        if samples is not None and samples.timestamps_s[-1] - samples.timestamps_s[0] <= _MAX_MOTION_S:
            preintegrated = preintegrate(samples, self._gyro_bias, self.alignment.accel_bias_m_s2)
            motion = InertialMotion(
                duration_s=preintegrated.duration_s,
                rotation=log_so3(preintegrated.delta_rotation[None])[0],
                velocity=preintegrated.delta_velocity_m_s,
                position=preintegrated.delta_position_m,
                bias_gyro=preintegrated.gyro_bias_rad_s,
                bias_accel=preintegrated.accel_bias_m_s2,
                covariance=preintegrated.covariance,
            )
        return KeyframeImu(
            down_camera=down / np.linalg.norm(down),
            deviation_rad=max(_MIN_GRAVITY_DEVIATION_RAD, self.alignment.gravity_deviation_rad),
            T_imu_camera=self._history.model.T_imu_camera,
            motion=motion,
        )

    def _check(self, timestamps_s: Array, T_world_camera: Array) -> bool:
        """Return whether the IMU may be used; set ``trouble``, the time offset and the first gyroscope bias.

        A changed time offset empties the cache of motions.  If the camera rotates too little to compare
        rates, an earlier comparison without a fault counts.
        """
        self.trouble = find_sample_trouble(self._history)
        if self.trouble:
            return False
        first = int(np.searchsorted(timestamps_s, timestamps_s[-1] - _RATE_CHECK_S))
        check = check_rates(
            self._history, timestamps_s[first:], T_world_camera[first:, :3, :3], self.offset_s
        )
        if check is None:
            return self._has_agreed
        self.trouble = check.trouble
        if self.trouble:
            return False
        if check.offset_s != self.offset_s:
            self.offset_s = check.offset_s
            self._motions.clear()
        if not self._has_agreed:
            self._gyro_bias, self._has_agreed = check.gyro_bias_rad_s, True
        return True

    def _covered_by_samples(
        self, timestamps_s: Array, rows: list[int]
    ) -> tuple[list[int], list[Preintegration]]:
        """Return the newest of *rows* back to the first gap in the samples, and the motions between them.

        A gap is a motion between two successive rows for which samples are missing.  *rows* are ascending and
        not empty; the last one is always in the result.
        """
        covered = rows[-1:]
        motions: list[Preintegration] = []
        for first, second in reversed(list(pairwise(rows))):
            motion = self._motion_between(float(timestamps_s[first]), float(timestamps_s[second]))
            if motion is None:
                break
            covered.insert(0, first)
            motions.insert(0, motion)
        return covered, motions

    def _motion_between(self, begin_s: float, end_s: float) -> Preintegration | None:
        """Return the preintegrated motion between two times of the camera; None if samples are missing.

        It comes from the cache if no axis of the gyroscope's bias has changed by more than 0.005 rad/s since.
        It is preintegrated with the present gyroscope bias and an accelerometer bias of 0; `align_imu`
        corrects both.
        """
        motion = self._motions.get((begin_s, end_s))
        if motion is None or np.abs(motion.gyro_bias_rad_s - self._gyro_bias).max() > _MAX_BIAS_CHANGE_RAD_S:
            samples = self._history.between(begin_s, end_s, self.offset_s)
            if samples is None:
                return None
            motion = preintegrate(samples, self._gyro_bias, np.zeros(3))
            if len(self._motions) > _MAX_CACHED_MOTIONS:
                self._motions.clear()
            self._motions[begin_s, end_s] = motion
        return motion


class ImuScale:
    """Estimate the metric scale of a camera without depth by its IMU, repeatedly during the drive."""

    name = "the IMU"

    def __init__(self, imu: ImuEstimator) -> None:
        self._imu = imu

    def observe(self, timestamp_s: float, rgb: npt.NDArray[np.uint8], position_m: Array | None) -> None:
        """Do nothing: the mapper passes the IMU samples of frames to the `ImuEstimator` itself."""

    def is_due(self, timestamp_s: float, *, is_known: bool) -> bool:
        """Return whether the scale should be estimated at the frame of *timestamp_s*.

        *is_known*, whether there is a scale already, is not used: the estimate is repeated.
        """
        return self._imu.is_due(timestamp_s)

    def metres_per_unit(
        self, timestamps_s: Array, T_world_camera: Array, camera: Camera, depth: float
    ) -> float | None:
        """Return metres per unit of ``(n, 4, 4)`` poses; None while the standard deviation is above 1.5 %.

        The other arguments are those of `ImuEstimator.align`; *camera* is not used.
        """
        alignment = self._imu.align(timestamps_s, T_world_camera, depth, is_metric=False)
        if alignment is None or alignment.scale_deviation > _MAX_SCALE_DEVIATION:
            return None
        return alignment.scale


def level_start_pose(gravity_camera: Array | None) -> Array:
    """Return the pose ``T_world_camera`` ``(4, 4)`` of the first frame, at the origin of a world with z up.

    A level camera looks along x.  The pose of a camera that is not level is that of a level one, rotated by
    the smallest angle with which gravity points down.

    Args:
        gravity_camera: ``(3,)`` gravity in the frame of the camera, of any length above 0; None, if it could
            not be measured because the camera moved, assumes a level camera.
    """
    T_world_level = np.eye(4)
    T_world_level[:3, :3] = _R_WORLD_LEVEL_CAMERA
    if gravity_camera is None:
        return T_world_level
    T_world_camera: Array = upright_rotation(_R_WORLD_LEVEL_CAMERA @ gravity_camera) @ T_world_level
    return T_world_camera


def _spaced_rows(timestamps_s: Array) -> list[int]:
    """Return ascending rows of poses that are at least 0.2 s apart, beginning with the first pose.

    When poses are appended, rows are appended and none changes, so that motions between rows can be cached.
    """
    rows = [0]
    for row in range(1, len(timestamps_s)):
        if timestamps_s[row] - timestamps_s[rows[-1]] >= _POSE_STEP_S - 1e-6:
            rows.append(row)
    return rows
