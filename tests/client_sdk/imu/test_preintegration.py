"""Preintegration agrees with exact motion, and its Jacobians and covariance with numeric ones."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.imu.history import ImuHistory
from client_sdk.imu.preintegration import preintegrate
from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.errors import UsageError
from rse_pf.geometry import exp_se3, log_so3
from tests.kit.inertial_drive import GRAVITY, InertialDrive, Motion, SimulatedImu

MODEL = ImuModel(
    T_imu_camera=exp_se3(np.array([0.05, -0.02, 0.01, 0.3, -1.2, 0.8])),
    gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0,
)  # fmt: skip
DRIVE = InertialDrive(MODEL, Motion(turn_rad=0.8, fastest_hz=0.6), seed=3)
BIAS_GYRO, BIAS_ACCEL = np.array([0.02, -0.03, 0.01]), np.array([0.1, -0.2, 0.05])


def samples(begin_s: float = 1.0, end_s: float = 1.4, **options) -> ImuSamples:
    imu = SimulatedImu(DRIVE, 3.0, seed=5, **options)
    history = ImuHistory(MODEL)
    history.add(ImuSamples(imu.timestamps_s, imu.gyro, imu.accel, MODEL))
    found = history.between(begin_s, end_s)
    assert found is not None
    return found


@pytest.mark.parametrize("interval", [(1.0, 1.05), (1.0, 1.4), (0.7013, 1.9027)])
def test_preintegration_agrees_with_the_exact_motion(interval):
    R, p, v, _, _ = DRIVE.imu_state(np.array(interval))
    dt = interval[1] - interval[0]

    made = preintegrate(samples(*interval, is_exact=True), np.zeros(3), np.zeros(3))

    assert made.duration_s == pytest.approx(dt)
    np.testing.assert_allclose(made.delta_rotation, R[0].T @ R[1], atol=3e-5)
    np.testing.assert_allclose(made.delta_velocity_m_s, R[0].T @ (v[1] - v[0] - GRAVITY * dt), atol=3e-4)
    position = R[0].T @ (p[1] - p[0] - v[0] * dt - 0.5 * GRAVITY * dt**2)
    np.testing.assert_allclose(made.delta_position_m, position, atol=3e-4)


def errors_between(made, other):
    """Return the difference of *other* from *made* ``(9,)``: rotation vector, velocity, position."""
    turned = log_so3((made.delta_rotation.T @ other.delta_rotation)[None])[0]
    return np.concatenate(
        [
            turned,
            other.delta_velocity_m_s - made.delta_velocity_m_s,
            other.delta_position_m - made.delta_position_m,
        ]
    )


def test_the_jacobian_is_that_of_numeric_differentiation():
    measured = samples()
    made = preintegrate(measured, BIAS_GYRO, BIAS_ACCEL)
    step = 1e-5
    for column in range(6):
        moved = np.zeros(6)
        moved[column] = step
        more = preintegrate(measured, BIAS_GYRO + moved[:3], BIAS_ACCEL + moved[3:])
        less = preintegrate(measured, BIAS_GYRO - moved[:3], BIAS_ACCEL - moved[3:])
        numeric = (errors_between(made, more) - errors_between(made, less)) / (2 * step)
        np.testing.assert_allclose(made.bias_jacobian[:, column], numeric, atol=1e-6)


def test_the_covariance_is_that_of_many_noisy_measurements():
    exact = samples(is_exact=True)
    made = preintegrate(exact, np.zeros(3), np.zeros(3))
    rng = np.random.default_rng(1)
    # The midpoint rule averages two samples: noise of one interval belongs to both of its ends.
    runs = []
    for _ in range(600):
        noise = rng.normal(size=(2, len(exact), 3)) * np.sqrt(MODEL.rate_hz)
        noisy = ImuSamples(
            exact.timestamps_s, exact.gyro + MODEL.gyro_noise * noise[0],
            exact.accel + MODEL.accel_noise * noise[1], MODEL,
        )  # fmt: skip
        runs.append(errors_between(made, preintegrate(noisy, np.zeros(3), np.zeros(3))))
    measured = np.sqrt(np.diag(np.cov(np.array(runs).T)))
    np.testing.assert_allclose(np.sqrt(np.diag(made.covariance)), measured, rtol=0.15)


def test_one_sample_is_no_interval():
    one = ImuSamples(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)), MODEL)
    with pytest.raises(UsageError, match="1 IMU samples"):
        preintegrate(one, np.zeros(3), np.zeros(3))


def test_the_history_gives_no_interval_with_missing_samples():
    imu = SimulatedImu(DRIVE, 3.0, seed=5)
    history = ImuHistory(MODEL)
    for begin_s, end_s in ((0.0, 1.0), (1.0, 1.1), (1.3, 2.0)):
        history.add(imu.between(begin_s, end_s))

    assert history.between(0.2, 1.05) is not None
    assert history.between(1.0, 1.6) is None
    assert history.between(1.9, 2.2) is None
    assert history.between(-0.2, 0.2) is None


def test_a_shift_of_the_history_is_that_of_the_clock_of_the_imu():
    imu = SimulatedImu(DRIVE, 3.0, seed=5, is_exact=True)
    history = ImuHistory(MODEL)
    history.add(ImuSamples(imu.timestamps_s + 0.02, imu.gyro, imu.accel, MODEL))

    found = history.between(1.0, 1.4, shift_s=0.02)

    assert found is not None
    np.testing.assert_allclose(found.gyro[0], samples(is_exact=True).gyro[0], atol=1e-9)
