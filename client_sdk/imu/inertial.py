"""One IMU over a drive: whether it may be used, how the camera turns between frames, gravity and metres."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from client_sdk.imu.alignment import GRAVITY_M_S2, Alignment, align
from client_sdk.imu.checks import RateCheck, check_rates, trouble_of_samples
from client_sdk.imu.history import ImuHistory
from client_sdk.imu.preintegration import Preintegration, preintegrate
from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, Camera, exp_so3, log_so3
from rse_pf.slam.inertial import InertialMotion, KeyframeImu, upright_rotation

__all__ = ["ImuScale", "Inertial", "upright"]

_STEP_S, _MOST_POSES, _FEWEST_POSES = 0.2, 150, 8
"""Poses so far apart are aligned, those of the last 30 seconds."""
_FIRST_S, _NEXT_S = 0.5, 2.0
"""An alignment is tried so often before metres are known, and after."""
_POSE_PX = 0.33
"""A tracked pose is wrong by about so many pixels."""
_WELL_KNOWN = 0.015
"""Metres are known when their deviation is below this share."""
_GRAVITY_RAD = math.radians(0.5)
_MOST_MISFIT, _MOST_MISFITS = 12.0, 3
"""An IMU that does not agree so often in a row is not used: a wrong pose alone does not speak against it."""
_SAME_BIAS = 0.005
_RATES_S = 20.0
_LONGEST_S = 10.0
"""A longer motion between keyframes tells nothing, and is not sent."""
_LEAST_GRAVITY_RAD = 1e-3
_AT_REST = 0.25
"""The first samples point up if their length differs from gravity by less than this share."""

_LEVEL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""``R_world_camera`` of a level camera: x ahead, y left, z up (ROS REP 103)."""


class Inertial:
    """What is known of an IMU, its biases and gravity, at this point of a drive.

    ``trouble`` says in one line why the IMU is not used; empty while it may be.  ``offset_s`` is by how much
    its clock is ahead of the camera's, as it was measured.  ``alignment`` is the last one.
    """

    def __init__(self, model: ImuModel, camera: Camera) -> None:
        self.trouble = ""
        self.offset_s = 0.0
        self.alignment: Alignment | None = None
        self._history = ImuHistory(model)
        self._camera = camera
        self._bias_gyro: Array = np.zeros(3)
        self._is_trusted = False
        self._due_s = float("-inf")
        self._misfits = 0
        self._motions: dict[tuple[float, float], Preintegration | None] = {}

    def add(self, samples: ImuSamples) -> None:
        """Take the samples of a frame."""
        self._history.add(samples)

    def turn(self, begin_s: float, end_s: float) -> Array | None:
        """Return ``R_begin_end`` ``(3, 3)`` of the camera between two times; None if it is not known."""
        if not self._is_trusted or self.trouble:
            return None
        samples = self._history.between(begin_s, end_s, self.offset_s)
        if samples is None:
            return None
        rates = 0.5 * (samples.gyro[1:] + samples.gyro[:-1]) - self._bias_gyro
        R = np.eye(3)
        for step in exp_so3(rates * np.diff(samples.timestamps_s)[:, None]):
            R = R @ step
        R_imu_camera = self._history.model.T_imu_camera[:3, :3]
        turned: Array = R_imu_camera.T @ R @ R_imu_camera
        return turned

    def forget(self) -> None:
        """Forget where gravity is: the world of the poses is another one."""
        self.alignment, self._due_s = None, float("-inf")

    def is_due(self, timestamp_s: float) -> bool:
        """Return whether it is time for another alignment."""
        return not self.trouble and timestamp_s >= self._due_s

    def align(
        self, timestamps_s: Array, T_world_camera: Array, depth: float, *, is_metric: bool
    ) -> Alignment | None:
        """Return the alignment of the newest tracked poses; None if nothing is well known, or in `trouble`.

        Args:
            timestamps_s: ``(n,)``, ascending.
            T_world_camera: ``(n, 4, 4)``.
            depth: Median depth of what the camera sees, in the unit of the poses.
            is_metric: Whether that is the metre.
        """
        self.alignment = None
        if not len(timestamps_s) or self.trouble:
            return None
        self._due_s = float(timestamps_s[-1]) + _FIRST_S
        if not self._check(timestamps_s, T_world_camera):
            return None
        rows = _spaced(timestamps_s)[-_MOST_POSES:]
        rows, motions = self._covered(timestamps_s, rows)
        if len(rows) < _FEWEST_POSES:
            return None
        angle = _POSE_PX / self._camera.fx
        noise = angle, angle * depth
        try:
            found = align(T_world_camera[rows], motions, self._history.model, noise, is_metric=is_metric)
        except UsageError as error:
            self.trouble = error.message
            return None
        if found is None:
            return None
        self._misfits = self._misfits + 1 if found.misfit > _MOST_MISFIT else 0
        if self._misfits >= _MOST_MISFITS:
            self.trouble = (
                f"the accelerometer does not agree with the camera: {found.misfit:.1f} deviations apart; "
                "are its axes, its unit and its noise right?"
            )
        if self._misfits:
            return None
        self._bias_gyro = found.bias_gyro[-1]
        self.alignment = found
        if found.gravity_deviation <= _GRAVITY_RAD and found.scale_deviation <= _WELL_KNOWN:
            self._due_s = float(timestamps_s[-1]) + _NEXT_S
        return found

    @property
    def gravity(self) -> Array | None:
        """The ``(3,)`` gravity of the last alignment, in the world of its poses; None if it is not known."""
        found = self.alignment
        return None if found is None or found.gravity_deviation > _GRAVITY_RAD else found.gravity

    def first_gravity(self) -> Array | None:
        """Return gravity ``(3,)`` in the frame of the camera by the samples so far, as if it stood still.

        None if it moves, or the unit is another one.
        """
        accel = self._history.mean_accel()
        if accel is None or abs(float(np.linalg.norm(accel)) / GRAVITY_M_S2 - 1.0) > _AT_REST:
            return None
        down: Array = -(self._history.model.T_imu_camera[:3, :3].T @ accel)
        return down

    def keyframe(
        self, T_world_camera: Array, since_s: float | None, timestamp_s: float
    ) -> KeyframeImu | None:
        """Return what a keyframe tells of the IMU; None while gravity is not known.

        Args:
            T_world_camera: ``(4, 4)``, its pose in the world of the last alignment.
            since_s: Time of the previous keyframe of the segment; None if there is none.
            timestamp_s: Its time.
        """
        gravity = self.gravity
        if gravity is None or self.alignment is None or self.trouble:
            return None
        down = T_world_camera[:3, :3].T @ gravity
        samples = None if since_s is None else self._history.between(since_s, timestamp_s, self.offset_s)
        motion = None
        if samples is not None and samples.timestamps_s[-1] - samples.timestamps_s[0] <= _LONGEST_S:
            made = preintegrate(samples, self._bias_gyro, self.alignment.bias_accel[-1])
            motion = InertialMotion(
                duration_s=made.duration_s, rotation=log_so3(made.rotation[None])[0], velocity=made.velocity,
                position=made.position, bias_gyro=made.bias_gyro, bias_accel=made.bias_accel,
                covariance=made.covariance,
            )  # fmt: skip
        return KeyframeImu(
            down_camera=down / np.linalg.norm(down),
            deviation_rad=max(_LEAST_GRAVITY_RAD, self.alignment.gravity_deviation),
            T_imu_camera=self._history.model.T_imu_camera, motion=motion,
        )  # fmt: skip

    def _check(self, timestamps_s: Array, T_world_camera: Array) -> bool:
        """Say whether the IMU may be used; find its offset in time and a first bias of the gyroscope."""
        self.trouble = trouble_of_samples(self._history)
        if self.trouble:
            return False
        first = int(np.searchsorted(timestamps_s, timestamps_s[-1] - _RATES_S))
        checked: RateCheck | None = check_rates(
            self._history, timestamps_s[first:], T_world_camera[first:, :3, :3], self.offset_s
        )
        if checked is None:
            return self._is_trusted
        self.trouble = checked.trouble
        if self.trouble:
            return False
        if checked.offset_s != self.offset_s:
            self.offset_s = checked.offset_s
            self._motions.clear()
        if not self._is_trusted:
            self._bias_gyro, self._is_trusted = checked.bias_gyro, True
        return True

    def _covered(self, timestamps_s: Array, rows: list[int]) -> tuple[list[int], list[Preintegration]]:
        """Return the newest rows that have samples between all of them, and the motions between them."""
        kept = rows[-1:]
        motions: list[Preintegration] = []
        for first, second in reversed(list(pairwise(rows))):
            motion = self._motion(float(timestamps_s[first]), float(timestamps_s[second]))
            if motion is None:
                break
            kept.insert(0, first)
            motions.insert(0, motion)
        return kept, motions

    def _motion(self, begin_s: float, end_s: float) -> Preintegration | None:
        known = self._motions.get((begin_s, end_s))
        if known is None or np.abs(known.bias_gyro - self._bias_gyro).max() > _SAME_BIAS:
            samples = self._history.between(begin_s, end_s, self.offset_s)
            if samples is None:
                return None
            known = preintegrate(samples, self._bias_gyro, np.zeros(3))
            if len(self._motions) > 4 * _MOST_POSES:
                self._motions.clear()
            self._motions[begin_s, end_s] = known
        return known


class ImuScale:
    """Scale by an IMU; it goes on improving."""

    name = "the IMU"

    def __init__(self, inertial: Inertial) -> None:
        self._inertial = inertial

    def observe(self, timestamp_s: float, rgb: npt.NDArray[np.uint8], position_m: Array | None) -> None:
        """Take nothing: the samples come with the frames."""

    def is_due(self, timestamp_s: float, *, is_known: bool) -> bool:
        """Return whether another estimate is worth its time."""
        return self._inertial.is_due(timestamp_s)

    def metres_per_unit(
        self, timestamps_s: Array, T_world_camera: Array, camera: Camera, depth: float
    ) -> float | None:
        """Return the scale once its deviation is below 1.5 percent."""
        found = self._inertial.align(timestamps_s, T_world_camera, depth, is_metric=False)
        return None if found is None or found.scale_deviation > _WELL_KNOWN else found.scale


def upright(gravity_camera: Array) -> Array:
    """Return ``T_world_camera`` ``(4, 4)`` of a first camera, so that z of the world points up.

    A level camera looks along x; another one is turned by the smallest angle that brings gravity down.

    Args:
        gravity_camera: ``(3,)`` of any length, in the frame of the camera.
    """
    made = np.eye(4)
    made[:3, :3] = _LEVEL
    turned: Array = upright_rotation(_LEVEL @ gravity_camera) @ made
    return turned


def _spaced(timestamps_s: Array) -> list[int]:
    """Return rows that are at least one step apart: the same ones whenever the drive is longer."""
    rows = [0]
    for row in range(1, len(timestamps_s)):
        if timestamps_s[row] - timestamps_s[rows[-1]] >= _STEP_S - 1e-6:
            rows.append(row)
    return rows
