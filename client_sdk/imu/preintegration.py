"""Preintegrate the samples of an IMU between two frames on the manifold (Forster et al. 2017).

With *i* and *j* the frames of the IMU at begin and end, *g* gravity in the world and *dt* the duration::

    delta_rotation = R_world_i' R_world_j
    delta_velocity = R_world_i' (v_j - v_i - g dt)
    delta_position = R_world_i' (p_j - p_i - v_i dt - g dt^2 / 2)

The right sides contain the unknown poses, velocities and gravity.  The left sides depend on the samples and
the biases alone, so that they are computed once, and not again in each step of an optimisation.

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

# Parts of the error state: rotation vector, velocity, position, gyroscope bias, accelerometer bias.
_ROTATION = slice(0, 3)
_VELOCITY = slice(3, 6)
_POSITION = slice(6, 9)
_GYRO_BIAS = slice(9, 12)
_ACCEL_BIAS = slice(12, 15)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Preintegration:
    """Preintegrated motion between two frames, its covariance, and its derivatives by the biases.

    Attributes:
        delta_rotation: ``(3, 3)`` rotation from the IMU's frame at the end to that at the begin.
        delta_velocity_m_s: ``(3,)`` change of velocity without gravity, in the IMU's frame at the begin.
        delta_position_m: ``(3,)`` change of position without initial velocity and gravity, in the same frame.
        duration_s: Time between the two frames, above 0.
        covariance: ``(9, 9)`` covariance of the errors of rotation (a rotation vector on the right, rad),
            velocity (m/s) and position (m), in this order.
        bias_jacobian: ``(9, 6)`` derivatives of rotation (a rotation vector on the right), velocity and
            position by the biases of gyroscope and accelerometer; with them the motion is corrected for small
            changes of the biases.
        gyro_bias_rad_s: ``(3,)`` bias that was subtracted from the angular rates.
        accel_bias_m_s2: ``(3,)`` bias that was subtracted from the specific forces.
    """

    delta_rotation: Array
    delta_velocity_m_s: Array
    delta_position_m: Array
    duration_s: float
    covariance: Array
    bias_jacobian: Array
    gyro_bias_rad_s: Array
    accel_bias_m_s2: Array


def preintegrate(samples: ImuSamples, gyro_bias_rad_s: Array, accel_bias_m_s2: Array) -> Preintegration:
    """Preintegrate from the first sample to the last one, with the midpoint rule.

    Args:
        samples: Two samples or more; their white noise is that of their model.
        gyro_bias_rad_s: ``(3,)``, subtracted from the angular rates.
        accel_bias_m_s2: ``(3,)``, subtracted from the specific forces.

    Raises:
        UsageError: There are fewer than two samples.

    Source:
        Forster et al. 2017, Sect. VI and appendices A and B.  While integrating, the biases are part of the
        error state, so that one product of ``(15, 15)`` matrices propagates both.  The result keeps the
        ``(9, 9)`` covariance and the ``(9, 6)`` derivatives by the biases.
    """
    if len(samples) < 2:
        raise UsageError(
            f"{len(samples)} IMU samples cannot be integrated: 2 or more are needed",
            hint="give the samples from the first frame to the second one",
        )
    # 1. Take mean rates and forces of each step, and the rotations of whole and half steps.
    dt = np.diff(samples.timestamps_s)
    rates = 0.5 * (samples.gyro[1:] + samples.gyro[:-1]) - gyro_bias_rad_s
    accels = 0.5 * (samples.accel[1:] + samples.accel[:-1]) - accel_bias_m_s2
    rotation_vectors = rates * dt[:, None]
    step_rotations, half_rotations = exp_so3(rotation_vectors), exp_so3(0.5 * rotation_vectors)
    rotation_by_rate = right_jacobian_so3(rotation_vectors) * dt[:, None, None]
    half_rotation_by_rate = 0.5 * right_jacobian_so3(0.5 * rotation_vectors) * dt[:, None, None]
    accel_skews = skew(accels)
    gyro_variance = samples.model.gyro_noise**2 / dt
    accel_variance = samples.model.accel_noise**2 / dt
    rotation, velocity, position = np.eye(3), np.zeros(3), np.zeros(3)
    covariance, transition = np.zeros((15, 15)), np.eye(15)
    for row in range(len(dt)):
        step_s, middle_rotation = float(dt[row]), rotation @ half_rotations[row]
        # 2. Linearise the step: velocity by rotation and biases (Forster et al., eqs. A.7 to A.9), position
        # by half of the velocity's change.
        velocity_by_middle = -step_s * (middle_rotation @ accel_skews[row])
        A = np.eye(15)
        A[_ROTATION, _ROTATION] = step_rotations[row].T
        A[_ROTATION, _GYRO_BIAS] = -rotation_by_rate[row]
        A[_VELOCITY, _ROTATION] = velocity_by_middle @ half_rotations[row].T
        A[_VELOCITY, _GYRO_BIAS] = -velocity_by_middle @ half_rotation_by_rate[row]
        A[_VELOCITY, _ACCEL_BIAS] = -step_s * middle_rotation
        A[_POSITION] += 0.5 * step_s * A[_VELOCITY]
        A[_POSITION, _VELOCITY] = step_s * np.eye(3)
        # 3. Propagate derivatives and covariance.  The white noise of a step has the same effect on rotation,
        #    velocity and position as a bias in this step alone, so it has the same derivatives.
        transition = A @ transition
        covariance = A @ covariance @ A.T
        by_gyro, by_accel = A[:, _GYRO_BIAS].copy(), A[:, _ACCEL_BIAS].copy()
        by_gyro[_GYRO_BIAS] = by_accel[_ACCEL_BIAS] = 0.0
        covariance += gyro_variance[row] * (by_gyro @ by_gyro.T)
        covariance += accel_variance[row] * (by_accel @ by_accel.T)
        # 4. Integrate the motion.
        velocity_change = middle_rotation @ accels[row] * step_s
        position = position + velocity * step_s + 0.5 * step_s * velocity_change
        velocity = velocity + velocity_change
        rotation = rotation @ step_rotations[row]
    return Preintegration(
        delta_rotation=rotation,
        delta_velocity_m_s=velocity,
        delta_position_m=position,
        duration_s=float(dt.sum()),
        covariance=covariance[:9, :9],
        bias_jacobian=transition[:9, 9:],
        gyro_bias_rad_s=np.array(gyro_bias_rad_s, dtype=np.float64),
        accel_bias_m_s2=np.array(accel_bias_m_s2, dtype=np.float64),
    )
