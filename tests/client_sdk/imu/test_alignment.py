"""Scale, gravity and biases of drives with exact truth, whatever the unit and the axes of their poses."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from client_sdk.imu.alignment import ImuAlignment, align_imu
from client_sdk.imu.history import ImuHistory
from client_sdk.imu.preintegration import preintegrate
from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.geometry import Array, exp_se3, exp_so3
from tests.kit.inertial_drive import InertialDrive, Motion, SimulatedImu

MODEL = ImuModel(
    T_imu_camera=exp_se3(np.array([0.05, -0.02, 0.01, 0.3, -1.2, 0.8])),
    gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0,
)  # fmt: skip
POSE_NOISE = 6e-4
"""A third of a pixel: rad, and per unit of depth."""
DEPTH_M, STEP_S = 3.0, 0.2


@dataclass
class Aligned:
    """Estimated alignment of a drive, and the true scale, direction of gravity and biases."""

    found: ImuAlignment | None
    scale: float
    down: Array
    bias: Array

    @property
    def scale_error(self) -> float:
        assert self.found is not None
        return abs(self.found.scale / self.scale - 1.0)

    @property
    def gravity_error_deg(self) -> float:
        assert self.found is not None
        return float(np.degrees(np.arccos(min(1.0, self.found.gravity_m_s2 @ self.down / 9.81))))


def aligned(seed: int, duration_s: float, *, noise: float = 1.0, motion: Motion | None = None) -> Aligned:
    rng = np.random.default_rng([seed, 5])
    drive = InertialDrive(MODEL, motion or Motion(), seed)
    imu = SimulatedImu(drive, duration_s, seed, is_exact=noise == 0.0)
    history = ImuHistory(MODEL)
    history.add(ImuSamples(imu.timestamps_s, imu.gyro, imu.accel, MODEL))
    stamps = np.arange(0.0, duration_s + 1e-9, STEP_S)
    T = drive.T_world_camera(stamps)
    scale, turned = float(rng.uniform(0.3, 3.0)), exp_so3(rng.normal(size=3))
    seen = T.copy()
    seen[:, :3, :3] = turned @ T[:, :3, :3] @ exp_so3(noise * POSE_NOISE * rng.normal(size=(len(T), 3)))
    seen[:, :3, 3] = (T[:, :3, 3] + noise * POSE_NOISE * DEPTH_M * rng.normal(size=(len(T), 3))) @ turned.T
    seen[:, :3, 3] /= scale
    motions = []
    for begin_s, end_s in pairwise(stamps.tolist()):
        part = history.between(begin_s, end_s)
        assert part is not None
        motions.append(preintegrate(part, np.zeros(3), np.zeros(3)))
    last = int(np.searchsorted(imu.timestamps_s, stamps[-2]))
    return Aligned(
        found=align_imu(seen, motions, MODEL, (POSE_NOISE, POSE_NOISE * DEPTH_M / scale)),
        scale=scale, down=turned @ np.array([0.0, 0.0, -1.0]),
        bias=np.concatenate([imu.bias_gyro[last], imu.bias_accel[last]]),
    )  # fmt: skip


def test_scale_and_gravity_are_exact_without_noise():
    drive = aligned(4, 6.0, noise=0.0)

    assert drive.scale_error < 1e-3
    assert drive.gravity_error_deg < 0.05


@pytest.mark.parametrize("seed", range(20))
def test_errors_with_noise_agree_with_the_standard_deviations(seed):
    drive = aligned(seed, 8.0)

    assert drive.found is not None
    assert drive.scale_error < min(0.02, 3.5 * drive.found.scale_deviation)
    assert drive.gravity_error_deg < 0.5
    assert np.radians(drive.gravity_error_deg) < 3.5 * drive.found.gravity_deviation_rad
    assert np.abs(drive.found.gyro_bias_rad_s - drive.bias[:3]).max() < 2e-3
    assert np.abs(drive.found.accel_bias_m_s2 - drive.bias[3:]).max() < 0.2
    assert 0.8 < drive.found.misfit < 1.25


def test_a_stationary_drone_gets_its_scale_after_it_has_moved():
    at_rest = Motion(rests_s=4.0)
    standing, moving = aligned(2, 4.0, motion=at_rest), aligned(2, 9.0, motion=at_rest)

    assert standing.found is None or standing.found.scale_deviation > 0.05
    assert moving.found is not None
    assert moving.found.scale_deviation < 0.01
    assert moving.scale_error < 0.02
