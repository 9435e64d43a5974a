"""Invalid samples and models of an IMU are refused in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.errors import UsageError

MODEL = ImuModel(
    T_imu_camera=np.eye(4), gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0
)


def samples(n: int) -> ImuSamples:
    return ImuSamples(np.arange(n) / 200.0, np.zeros((n, 3)), np.zeros((n, 3)), MODEL)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_imu_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "no rigid motion"),
        ({"T_imu_camera": np.full((4, 4), np.nan)}, "no rigid motion"),
        ({"T_imu_camera": np.array([[1, 0, 0, 11.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])}, "10 m"),
        ({"gyro_noise": 0.0}, "gyro_noise = 0"),
        ({"accel_walk": float("inf")}, "accel_walk = inf"),
        ({"rate_hz": 1.0}, "rate_hz = 1 "),
        ({"max_accel": -1.0}, "max_accel"),
    ],
)
def test_refuses_a_model_that_no_imu_has(change, message):
    with pytest.raises(UsageError, match=message):
        replace(MODEL, **change)


@pytest.mark.parametrize(
    ("times", "gyro", "accel", "message"),
    [
        (np.arange(3.0), np.zeros((2, 3)), np.zeros((3, 3)), "do not fit"),
        (np.arange(3.0), np.zeros((3, 3)), np.zeros((3, 2)), "do not fit"),
        (np.array([0.0, 2.0, 1.0]), np.zeros((3, 3)), np.zeros((3, 3)), "ascend"),
        (np.array([0.0, 1.0, 1.0]), np.zeros((3, 3)), np.zeros((3, 3)), "ascend"),
        (np.arange(3.0), np.full((3, 3), np.nan), np.zeros((3, 3)), "finite"),
        (np.arange(1e6), np.zeros((1_000_000, 3)), np.zeros((1_000_000, 3)), "1000000 IMU samples"),
    ],
)
def test_refuses_samples_that_no_imu_gives(times, gyro, accel, message):
    with pytest.raises(UsageError, match=message):
        ImuSamples(times, gyro, accel, MODEL)
