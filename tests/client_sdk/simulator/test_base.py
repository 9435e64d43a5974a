"""The robot on wheels: exact motion, wheels that slip or lie, and walls that stop it."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.simulator.base import (
    STEP_S,
    T_BASE_CAMERA,
    BaseDrive,
    DifferentialBase,
    Lie,
    drive_route,
    render_base,
)
from client_sdk.simulator.building import BUILDINGS, Building, make_building
from client_sdk.trajectory import Trajectory
from rse_pf.errors import UsageError
from rse_pf.geometry import inverse, transform


@pytest.fixture(scope="module")
def hall() -> Building:
    return make_building("hall", 0)


@pytest.fixture(scope="module")
def drive(hall: Building) -> BaseDrive:
    return drive_route(hall, hall.route(0, 60.0))


def odometry_error_m(drive: BaseDrive, lie: Lie) -> float:
    """Return the error of the position at the end by wheels that lie after 5 s."""
    poses = drive.T_building_base
    T_start_end = inverse(poses[0]) @ poses[-1]
    _, T_odom_base = drive.odometry(0, lie=lie, lies_after_s=5.0)[-1][-1]
    return float(np.linalg.norm(T_odom_base[:2, 3] - T_start_end[:2, 3]))


@pytest.mark.parametrize("name", BUILDINGS)
def test_a_base_drives_a_long_route_through_each_building_without_collision(name: str) -> None:
    building = make_building(name, 1)

    driven = drive_route(building, building.route(3, 60.0))

    assert driven.collisions == 0
    assert 55.0 < driven.truth.length_m < 120.0


def test_commands_drive_an_exact_arc(hall: Building) -> None:
    base = DifferentialBase(hall, 5.5, 5.5, 0.0)
    ways = np.array([base.step(0.4, 0.4) for _ in range(50)])

    turned_m = ways.sum(axis=0)
    assert base.yaw_rad == pytest.approx((turned_m[1] - turned_m[0]) / 0.35)
    assert base.x_m > 5.9
    assert base.y_m > 5.6
    assert ways[-1].mean() == pytest.approx(0.4 * STEP_S)


def test_a_wall_stops_the_base_while_its_wheels_turn(hall: Building) -> None:
    base = DifferentialBase(hall, 1.5, 1.5, np.pi)
    way_m = sum(np.mean(base.step(0.5, 0.0)) for _ in range(75))

    assert base.collisions == 1
    assert hall.distance_m(base.x_m, base.y_m) >= 0.2
    assert way_m > 1.2 > 2 * (1.5 - base.x_m)
    with pytest.raises(UsageError, match="from a wall"):
        DifferentialBase(hall, 0.5, 0.5, 0.0)


def test_wheels_slip_by_percents_and_lies_are_far_larger(drive: BaseDrive) -> None:
    honest_m = odometry_error_m(drive, "none")

    assert 0.1 < honest_m < 0.1 * drive.truth.length_m
    assert odometry_error_m(drive, "blocked") > 2.0
    assert odometry_error_m(drive, "frozen") > 2.0


def test_late_wheels_state_a_later_time_for_the_same_poses(drive: BaseDrive) -> None:
    honest, late = (drive.odometry(0, lie=lie)[10] for lie in ("none", "late"))

    for (stamp_s, pose), (late_s, late_pose) in zip(honest, late, strict=True):
        assert late_s == pytest.approx(stamp_s + 0.1)
        np.testing.assert_array_equal(pose, late_pose)


def test_the_odometry_of_an_image_ends_at_the_time_of_the_image(drive: BaseDrive) -> None:
    truth, batches = drive.truth, drive.odometry(0)

    assert len(batches) == len(truth)
    assert [batch[-1][0] for batch in batches[1:]] == pytest.approx(truth.timestamps_s[1:].tolist())


def test_the_camera_sees_the_floor_where_its_mount_says(hall: Building, drive: BaseDrive) -> None:
    truth = drive.truth
    frame = next(render_base(hall, Trajectory(truth.timestamps_s[:1], truth.T_world_camera[:1]), (0,)))
    camera, depth_m = frame.camera, float(np.median(frame.depth_m[200:205, 155:165]))
    ray = np.array([[0.0, (202.0 - camera.cy) / camera.fy, 1.0]])

    assert frame.depth_m.shape == (240, 320)
    assert transform(T_BASE_CAMERA, depth_m * ray)[0, 2] == pytest.approx(0.0, abs=0.02)


def test_an_unknown_building_is_an_error() -> None:
    with pytest.raises(UsageError, match="no building 'tower'"):
        make_building("tower", 0)
