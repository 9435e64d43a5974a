"""A camera with an IMU that moves smoothly, with exact poses, rates and accelerations.

The motion is a sum of sines, of which all derivatives are known; z of the world points up.  Nothing is
rendered.  The same arguments give the same motion and the same noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.geometry import Array, exp_so3, right_jacobian_so3

__all__ = ["GRAVITY", "InertialDrive", "Motion", "SimulatedImu"]

GRAVITY: Array = np.array([0.0, 0.0, -9.81])
_ACCELERATION_S = 1.0  # time in which a stationary drone reaches its full motion
_WAVES = 3  # sines of which each coordinate of the motion is the sum
_MARGIN_S = 0.5  # time before and after a drive in which the IMU has samples, too


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Size and speed of a camera's motion.

    Attributes:
        reach_m: Approximate largest distance from the origin.
        turn_rad: Approximate largest rotation against the first orientation.
        slowest_hz: Lowest frequency of the motion.
        fastest_hz: Highest frequency of the motion.
        rests_s: Time for which the camera is stationary before it accelerates within a second.
    """

    reach_m: float = 1.0
    turn_rad: float = 0.35
    slowest_hz: float = 0.08
    fastest_hz: float = 0.35
    rests_s: float = 0.0


class InertialDrive:
    """Exact motion of a camera and of the IMU that is mounted with it."""

    def __init__(self, model: ImuModel, motion: Motion, seed: int) -> None:
        self.model, self.motion = model, motion
        rng = np.random.default_rng([seed, 71])
        self._hz = rng.uniform(motion.slowest_hz, motion.fastest_hz, (2, 3, _WAVES))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3, _WAVES))
        size = np.array([motion.reach_m, motion.turn_rad])[:, None, None] / math.sqrt(_WAVES)
        self._size = size * rng.uniform(0.5, 1.0, (2, 3, _WAVES))
        yaw = rng.uniform(-np.pi, np.pi)
        # The axes of a camera that looks ahead, a little down: x right, y down, z ahead.
        ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
        level = np.column_stack([np.cross(ahead, [0.0, 0.0, 1.0]), [0.0, 0.0, -1.0], ahead])
        self._start = level @ exp_so3(np.array([rng.uniform(-0.3, 0.1), 0.0, rng.uniform(-0.1, 0.1)]))

    def imu_state(self, stamps_s: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return rotations ``R_world_imu``, positions, velocities, rates, and accelerations of the IMU.

        Rates are in the frame of the IMU, rad/s; all others in the world, metres and seconds.
        """
        position, turn = self._waves(stamps_s, 0), self._waves(stamps_s, 1)
        R_camera_imu = self.model.T_imu_camera[:3, :3].T
        R = self._start @ exp_so3(turn[0]) @ R_camera_imu
        rates = np.einsum("nij,nj->ni", right_jacobian_so3(turn[0]), turn[1]) @ R_camera_imu
        return R, position[0], position[1], rates, position[2]

    def T_world_camera(self, stamps_s: Array) -> Array:
        """Return the true ``(n, 4, 4)`` poses of the camera."""
        R, position, *_ = self.imu_state(stamps_s)
        T = np.tile(np.eye(4), (len(stamps_s), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = R, position
        T_world_camera: Array = T @ self.model.T_imu_camera
        return T_world_camera

    def _waves(self, stamps_s: Array, which: int) -> tuple[Array, Array, Array]:
        """Return positions (*which* = 0) or rotation vectors (1) ``(n, 3)``, and their first two derivatives.

        All are 0 while the camera is stationary.
        """
        w = 2.0 * np.pi * self._hz[which]
        angles = stamps_s[:, None, None] * w + self._phase[which]
        size = self._size[which]
        value = (size * np.sin(angles)).sum(axis=2)
        first = (size * w * np.cos(angles)).sum(axis=2)
        second = -(size * w * w * np.sin(angles)).sum(axis=2)
        if self.motion.rests_s <= 0.0:
            return value, first, second
        # 10 x^3 - 15 x^4 + 6 x^5 has no velocity and no acceleration at both of its ends.
        x = np.clip((stamps_s - self.motion.rests_s) / _ACCELERATION_S, 0.0, 1.0)[:, None]
        s = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        ds = 30.0 * x**2 * (1.0 - x) ** 2 / _ACCELERATION_S
        dds = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) / _ACCELERATION_S**2
        return s * value, ds * value + s * first, dds * value + 2.0 * ds * first + s * second


class SimulatedImu:
    """Samples of an IMU in a drive, with white noise and randomly walking biases.

    ``timestamps_s`` ``(n,)`` is on the camera's clock; ``bias_gyro`` (rad/s) and ``bias_accel`` (m/s^2) are
    the true biases ``(n, 3)``.
    """

    def __init__(
        self, drive: InertialDrive, duration_s: float, seed: int, *,
        bias_gyro: Array | None = None, bias_accel: Array | None = None, is_exact: bool = False,
    ) -> None:  # fmt: skip
        """Measure the drive from half a second before its begin to half a second after its end.

        Args:
            drive: Motion that is measured.
            duration_s: Duration of the drive.
            seed: Seed of noise and biases.
            bias_gyro: First bias ``(3,)`` of the gyroscope; None draws one of about 0.02 rad/s.
            bias_accel: First bias ``(3,)`` of the accelerometer; None draws one of about 0.05 m/s^2.
            is_exact: Whether there is neither noise nor bias.
        """
        rng = np.random.default_rng([seed, 72])
        model = drive.model
        count = int((duration_s + 2.0 * _MARGIN_S) * model.rate_hz) + 1
        self.timestamps_s: Array = -_MARGIN_S + np.arange(count) / model.rate_hz
        R, _, _, rates, accelerations = drive.imu_state(self.timestamps_s)
        force = np.einsum("nji,nj->ni", R, accelerations - GRAVITY)
        walk, white = math.sqrt(1.0 / model.rate_hz), math.sqrt(model.rate_hz)
        first_gyro = rng.normal(0.0, 0.02, 3) if bias_gyro is None else bias_gyro
        first_accel = rng.normal(0.0, 0.05, 3) if bias_accel is None else bias_accel
        noise = rng.normal(size=(4, count, 3)) * (0.0 if is_exact else 1.0)
        own = 0.0 if is_exact else 1.0
        self.bias_gyro: Array = own * first_gyro + model.gyro_walk * walk * np.cumsum(noise[0], axis=0)
        self.bias_accel: Array = own * first_accel + model.accel_walk * walk * np.cumsum(noise[1], axis=0)
        self.gyro: Array = rates + self.bias_gyro + model.gyro_noise * white * noise[2]
        self.accel: Array = force + self.bias_accel + model.accel_noise * white * noise[3]
        self.model = model

    def between(self, begin_s: float, end_s: float) -> ImuSamples:
        """Return the samples of an interval, with one at or before its begin and one at or after its end."""
        first = max(0, int(np.searchsorted(self.timestamps_s, begin_s, side="right")) - 1)
        last = int(np.searchsorted(self.timestamps_s, end_s, side="left")) + 1
        rows = slice(first, last)
        return ImuSamples(self.timestamps_s[rows], self.gyro[rows], self.accel[rows], self.model)
