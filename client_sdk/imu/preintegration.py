"""The motion between two frames as an IMU measured it, whatever its velocity and the direction of gravity.

*i* and *j* are the frames of the IMU at the begin and the end, *g* is gravity in the world::

    rotation = R_world_i' R_world_j
    velocity = R_world_i' (v_j - v_i - g dt)
    position = R_world_i' (p_j - p_i - v_i dt - g dt^2 / 2)

Source:
    Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", T-RO 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from client_sdk.imu.samples import ImuSamples
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, exp_so3, right_jacobian_so3, skew

__all__ = ["Preintegration", "preintegrate"]

_PHI, _V, _P, _BG, _BA = (slice(3 * number, 3 * number + 3) for number in range(5))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Preintegration:
    """A preintegrated motion with its covariance, and how it changes with the biases.

    Attributes:
        rotation: ``(3, 3)``.
        velocity: ``(3,)`` m/s.
        position: ``(3,)`` m.
        duration_s: Above 0.
        covariance: ``(9, 9)`` of the errors (rotation vector on the right, velocity, position).
        jacobian: ``(9, 6)``, derivative of these by the biases of gyroscope and accelerometer.
        bias_gyro: ``(3,)`` rad/s, which was subtracted.
        bias_accel: ``(3,)`` m/s^2, which was subtracted.
    """

    rotation: Array
    velocity: Array
    position: Array
    duration_s: float
    covariance: Array
    jacobian: Array
    bias_gyro: Array
    bias_accel: Array


def preintegrate(samples: ImuSamples, bias_gyro: Array, bias_accel: Array) -> Preintegration:
    """Integrate from the first sample to the last one, by the midpoint rule.

    Args:
        samples: Two or more.
        bias_gyro: ``(3,)`` rad/s.
        bias_accel: ``(3,)`` m/s^2.

    Raises:
        UsageError: There are fewer than two samples.

    Source:
        Forster et al. 2017, Sect. VI and appendices A and B; the biases are states of the error, so that one
        product of ``(15, 15)`` matrices carries covariance and Jacobians.
    """
    if len(samples) < 2:
        raise UsageError(f"{len(samples)} IMU samples are no interval", hint="give two samples or more")
    dt = np.diff(samples.timestamps_s)
    omega = 0.5 * (samples.gyro[1:] + samples.gyro[:-1]) - bias_gyro
    accel = 0.5 * (samples.accel[1:] + samples.accel[:-1]) - bias_accel
    turns = omega * dt[:, None]
    steps, halves = exp_so3(turns), exp_so3(0.5 * turns)
    by_rate = right_jacobian_so3(turns) * dt[:, None, None]
    by_rate_half = 0.5 * right_jacobian_so3(0.5 * turns) * dt[:, None, None]
    crossed = skew(accel)
    model = samples.model
    gyro_variance, accel_variance = model.gyro_noise**2 / dt, model.accel_noise**2 / dt
    rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
    covariance, transition = np.zeros((15, 15)), np.eye(15)
    for row in range(len(dt)):
        step, middle = float(dt[row]), rotation @ halves[row]
        # Of the velocity, by the error of the rotation before, and by the biases (eqs. A.7 to A.9).
        turned = -step * (middle @ crossed[row])
        A = np.eye(15)
        A[_PHI, _PHI], A[_PHI, _BG] = steps[row].T, -by_rate[row]
        A[_V, _PHI], A[_V, _BG], A[_V, _BA] = (
            turned @ halves[row].T, -turned @ by_rate_half[row], -step * middle,
        )  # fmt: skip
        A[_P] += 0.5 * step * A[_V]
        A[_P, _V] = step * np.eye(3)
        transition = A @ transition
        covariance = A @ covariance @ A.T
        by_gyro, by_accel = A[:, _BG].copy(), A[:, _BA].copy()
        by_gyro[_BG] = by_accel[_BA] = 0.0
        covariance += gyro_variance[row] * (by_gyro @ by_gyro.T)
        covariance += accel_variance[row] * (by_accel @ by_accel.T)
        moved = middle @ accel[row] * step
        position = position + velocity * step + 0.5 * step * moved
        velocity = velocity + moved
        rotation = rotation @ steps[row]
    return Preintegration(
        rotation=rotation, velocity=velocity, position=position, duration_s=float(dt.sum()),
        covariance=covariance[:9, :9], jacobian=transition[:9, 9:],
        bias_gyro=np.array(bias_gyro, dtype=np.float64), bias_accel=np.array(bias_accel, dtype=np.float64),
    )  # fmt: skip
