"""A mapper whose frames carry an IMU: its world has z up, and is turned when gravity becomes known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.imu.estimator import ImuEstimator
from client_sdk.imu.samples import ImuModel, ImuSamples
from client_sdk.mapper import Mapper
from rse_pf.geometry import Array, exp_se3, inverse
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import STEP_M, frame_at, tracked

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

MODEL = ImuModel(
    T_imu_camera=exp_se3(np.array([0.05, -0.02, 0.01, 0.3, -1.2, 0.8])),
    gyro_noise=2e-4, gyro_walk=2e-5, accel_noise=2e-3, accel_walk=3e-3, rate_hz=200.0,
)  # fmt: skip
DOWN = np.array([0.1, 0.9, 0.3]) / np.linalg.norm([0.1, 0.9, 0.3])
"""Gravity in the frame of the camera, which does not turn."""


def with_imu(frame: Frame) -> Frame:
    stamps = frame.timestamp_s + np.arange(-20, 1) / 200.0
    accel = MODEL.T_imu_camera[:3, :3] @ (-9.81 * DOWN)
    samples = ImuSamples(stamps, np.zeros((21, 3)), np.tile(accel, (21, 1)), MODEL)
    return replace(frame, imu=samples)


def drive(mapper: Mapper, rows: range, *, depth: bool) -> list[TrackedFrame]:
    return tracked(mapper, (with_imu(frame_at(row, depth=depth)) for row in rows))


def down_in(T_world_camera: Array | None) -> Array:
    assert T_world_camera is not None
    down: Array = T_world_camera[:3, :3] @ DOWN
    return down


def test_gravity_points_along_minus_z_from_the_first_frame_on():
    mapper = Mapper(ask=solve)

    done = drive(mapper, range(3), depth=True)

    for each in done:
        np.testing.assert_allclose(down_in(each.T_world_camera), [0.0, 0.0, -1.0], atol=0.01)
    moved = mapper.trajectory.positions
    assert np.linalg.norm(moved[2] - moved[0]) == pytest.approx(2 * STEP_M, abs=0.01)
    assert mapper.report()["imu"] == "not used yet"


def test_a_start_pose_of_the_user_is_kept():
    start = exp_se3(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))

    done = drive(Mapper(ask=solve, T_world_start=start), range(2), depth=True)

    np.testing.assert_allclose(done[0].T_world_camera, start)


def test_frames_are_tracked_on_in_a_world_that_was_turned():
    mapper = Mapper(ask=solve)
    before = drive(mapper, range(3), depth=True)
    turned = exp_se3(np.array([0.0, 0.0, 0.0, 0.1, -0.05, 0.02]))
    tracker = mapper._tracker
    assert tracker is not None
    tracker.turn(turned)
    mapper._records.turn(turned)

    after = drive(mapper, range(3, 5), depth=True)

    first, last = before[0].T_world_camera, after[-1].T_world_camera
    assert first is not None
    assert last is not None
    moved = inverse(turned @ first) @ last
    assert moved[0, 3] == pytest.approx(4 * STEP_M, abs=0.02)
    np.testing.assert_allclose(mapper.trajectory.T_world_camera[0], turned @ first, atol=1e-9)
    assert len(mapper.map) > 2000


@pytest.fixture
def leaning_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the first samples give a wrong gravity, and the alignment the true one from the fourth frame on."""
    monkeypatch.setattr(ImuEstimator, "stationary_gravity", lambda imu: np.array([0.0, 9.0, 4.0]))
    monkeypatch.setattr(ImuEstimator, "is_due", lambda imu, timestamp_s: timestamp_s > 0.25)
    monkeypatch.setattr(ImuEstimator, "align", align_by_first_pose)
    monkeypatch.setattr(
        ImuEstimator, "gravity_m_s2", property(lambda imu: getattr(imu, "estimated_gravity", None))
    )


def align_by_first_pose(imu: Any, timestamps_s: Array, poses: Array, depth: float, **kind: bool) -> None:
    imu.estimated_gravity = 9.81 * poses[0, :3, :3] @ DOWN


@pytest.mark.usefixtures("leaning_first")
def test_a_rotation_of_the_world_is_returned_with_the_frame():
    done = drive(Mapper(ask=solve), range(6), depth=True)

    turns = [each.T_new_old for each in done if each.T_new_old is not None]
    assert [each.T_new_old is not None for each in done] == [each.corrected for each in done]
    assert [each.corrected for each in done] == [row == 3 for row in range(6)]
    assert abs(float(down_in(done[2].T_world_camera)[2] + 1.0)) > 0.01
    np.testing.assert_allclose(down_in(done[5].T_world_camera), [0.0, 0.0, -1.0], atol=0.02)
    first, last = done[2].T_world_camera, done[5].T_world_camera
    assert first is not None
    assert last is not None
    moved = inverse(turns[0] @ first) @ last
    np.testing.assert_allclose(moved[:3, 3], [3 * STEP_M, 0.0, 0.0], atol=0.02)
    np.testing.assert_allclose(moved[:3, :3], np.eye(3), atol=0.02)


def test_without_an_imu_the_world_is_that_of_the_first_camera():
    mapper = Mapper(ask=solve)

    (done,) = tracked(mapper, [frame_at(0, depth=True)])

    np.testing.assert_allclose(done.T_world_camera, np.eye(4))
    assert (mapper.imu, mapper.gravity) == ("none", None)
    assert "imu" not in mapper.report()
