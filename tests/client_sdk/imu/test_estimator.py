"""An IMU and tracked poses: scale, gravity, rotations; a faulty IMU is reported in one line and not used."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from client_sdk.imu.estimator import ImuEstimator, ImuScale, level_start_pose
from client_sdk.imu.samples import ImuModel, ImuSamples
from rse_pf.geometry import Array, Camera, exp_se3, exp_so3, inverse, rotation_angle_deg
from rse_pf.slam.inertial import upright_rotation
from tests.kit.inertial_drive import InertialDrive, Motion, SimulatedImu

CAMERA = Camera(fx=460.0, fy=460.0, cx=375.5, cy=239.5, width=752, height=480)
MODEL = ImuModel(
    T_imu_camera=exp_se3(np.array([0.05, -0.02, 0.01, 0.3, -1.2, 0.8])),
    gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0,
)  # fmt: skip
DEPTH_M, RATE_HZ, UNIT_M = 3.0, 20.0, 0.4
SEED = 6


@dataclass
class Driven:
    """Estimates of an IMU in a drive; ``scales`` has one entry per estimate, None while it is not known."""

    inertial: ImuEstimator
    drive: InertialDrive
    imu: SimulatedImu
    scales: list[float | None]
    stamps: Array
    T_world_camera: Array

    @property
    def scale_error(self) -> float:
        known = [scale for scale in self.scales if scale is not None]
        return abs(known[-1] / UNIT_M - 1.0)


Change = Callable[[ImuSamples], ImuSamples]


def driven(
    duration_s: float = 8.0,
    change: Change = lambda samples: samples,
    *,
    motion: Motion | None = None,
    model: ImuModel = MODEL,
) -> Driven:
    drive = InertialDrive(MODEL, motion or Motion(), SEED)
    imu = SimulatedImu(drive, duration_s, SEED)
    rng = np.random.default_rng(7)
    stamps = np.arange(0.0, duration_s, 1.0 / RATE_HZ)
    T = drive.T_world_camera(stamps)
    pixel = 0.3 / CAMERA.fx
    T[:, :3, :3] = T[:, :3, :3] @ exp_so3(pixel * rng.normal(size=(len(T), 3)))
    T[:, :3, 3] = (T[:, :3, 3] + pixel * DEPTH_M * rng.normal(size=(len(T), 3))) / UNIT_M
    inertial = ImuEstimator(model, CAMERA)
    source, scales = ImuScale(inertial), []
    for row, stamp in enumerate(stamps.tolist()):
        inertial.add(change(imu.between(max(-0.2, stamp - 1.0 / RATE_HZ), stamp)))
        if source.is_due(stamp, is_known=False):
            scales.append(source.metres_per_unit(stamps[: row + 1], T[: row + 1], CAMERA, DEPTH_M / UNIT_M))
    return Driven(inertial, drive, imu, scales, stamps, T)


def test_the_scale_is_returned_once_it_is_known_and_improves():
    made = driven()

    assert made.inertial.trouble == ""
    assert made.scales[0] is None
    assert made.scale_error < 0.01
    assert made.inertial.gravity_m_s2 is not None
    assert made.inertial.gravity_m_s2[2] / 9.81 == pytest.approx(-1.0, abs=1e-4)


def test_a_stationary_drone_has_no_scale():
    made = driven(9.0, motion=Motion(rests_s=4.0))
    before = sum(scale is not None for scale in driven(4.0, motion=Motion(rests_s=4.0)).scales)

    assert before == 0
    assert made.scale_error < 0.02


def test_the_gyroscope_predicts_the_rotation_of_the_camera():
    made = driven()
    T = made.drive.T_world_camera(np.array([7.5, 7.55]))

    turned = made.inertial.camera_rotation(7.5, 7.55)

    assert turned is not None
    assert rotation_angle_deg((inverse(T[0]) @ T[1])[:3, :3]) > 0.5
    assert rotation_angle_deg(turned.T @ (inverse(T[0]) @ T[1])[:3, :3]) < 0.02


@pytest.mark.parametrize("late_s", [0.02, -0.02])
def test_an_offset_in_time_is_found(late_s):
    made = driven(change=lambda samples: replace(samples, timestamps_s=samples.timestamps_s + late_s))

    assert made.inertial.trouble == ""
    assert made.inertial.offset_s == pytest.approx(late_s, abs=0.003)
    assert made.scale_error < 0.015


def swapped(samples: ImuSamples) -> ImuSamples:
    return replace(samples, gyro=samples.gyro[:, [1, 0, 2]], accel=samples.accel[:, [1, 0, 2]])


def flipped(samples: ImuSamples) -> ImuSamples:
    return replace(samples, gyro=samples.gyro * [1, 1, -1], accel=samples.accel * [1, 1, -1])


def thinned(samples: ImuSamples) -> ImuSamples:
    kept = np.rint(samples.timestamps_s * 200.0) % 5 > 0
    return replace(
        samples,
        timestamps_s=samples.timestamps_s[kept],
        gyro=samples.gyro[kept],
        accel=samples.accel[kept],
    )


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (swapped, "left-handed|T_imu_camera says"),
        (flipped, "left-handed|T_imu_camera says"),
        (lambda s: replace(s, gyro=s.gyro[:, [1, 2, 0]], accel=s.accel[:, [1, 2, 0]]), "turned by 120 deg"),
        (lambda s: replace(s, gyro=np.degrees(s.gyro)), "in degrees"),
        (lambda s: replace(s, accel=s.accel / 9.81), "in g"),
        (lambda s: replace(s, accel=3.0 * s.accel), "where gravity is 9.8"),
        (lambda s: replace(s, accel=s.accel[:, [1, 0, 2]]), "accelerometer"),
        (lambda s: replace(s, accel=-s.accel), "the opposite"),
        (lambda s: replace(s, timestamps_s=s.timestamps_s + 0.08), "(79|80|81) ms ahead"),
        (thinned, "are missing"),
        (
            lambda s: replace(s, gyro=s.gyro.clip(-0.1, 0.1), model=replace(MODEL, max_gyro=0.1)),
            "saturated at 0.1 rad/s",
        ),
    ],
)
def test_a_faulty_imu_is_reported_in_one_line_and_not_used(change, line):
    made = driven(change=change)

    assert made.inertial.trouble
    assert "\n" not in made.inertial.trouble
    assert re.search(line, made.inertial.trouble), made.inertial.trouble
    assert all(scale is None for scale in made.scales)
    assert made.inertial.camera_rotation(1.0, 1.05) is None


@pytest.mark.parametrize("factor", [0.9, 1.1])
@pytest.mark.parametrize("rests_s", [0.0, 4.0])
@pytest.mark.parametrize("seed", [3, 6])
def test_an_accelerometer_with_a_wrong_scale_is_reported(factor, rests_s, seed, monkeypatch):
    monkeypatch.setitem(globals(), "SEED", seed)
    made = driven(change=lambda s: replace(s, accel=factor * s.accel), motion=Motion(rests_s=rests_s))

    assert re.search("the accelerometer reads .*(9|10|11) % too (much|little)", made.inertial.trouble)
    assert ("too much" if factor > 1.0 else "too little") in made.inertial.trouble
    assert ("while stationary" in made.inertial.trouble) == (rests_s > 0.0)
    assert re.search(r"or it has a bias of (0\.9|1\.0|1\.1) m/s", made.inertial.trouble)
    assert all(scale is None for scale in made.scales)


@pytest.mark.parametrize("rests_s", [0.0, 4.0])
def test_an_accelerometer_with_a_usual_bias_is_used(rests_s):
    made = driven(
        10.0,
        change=lambda s: replace(s, accel=s.accel + np.array([0.2, -0.2, 0.2])),
        motion=Motion(rests_s=rests_s),
    )

    assert made.inertial.trouble == ""
    assert made.scale_error < 0.015


def test_an_inverted_mounting_is_reported():
    made = driven(change=lambda s: replace(s, model=replace(MODEL, T_imu_camera=inverse(MODEL.T_imu_camera))))

    assert "T_imu_camera says" in made.inertial.trouble


def test_the_world_of_a_level_camera_has_z_up_and_x_ahead():
    T = level_start_pose(np.array([0.0, 1.0, 0.0]))

    np.testing.assert_allclose(T[:3, 2], [1.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(T[:3, 1], [0.0, 0.0, -1.0], atol=1e-12)


def test_gravity_points_down_after_the_correction():
    rng = np.random.default_rng(1)
    for gravity in (*rng.normal(size=(20, 3)), np.array([0.0, 0.0, 5.0]), np.array([0.0, 0.0, -5.0])):
        T = upright_rotation(gravity)
        np.testing.assert_allclose(
            T[:3, :3] @ gravity / np.linalg.norm(gravity), [0.0, 0.0, -1.0], atol=1e-12
        )
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
