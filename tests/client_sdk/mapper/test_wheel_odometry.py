"""Wheels predict and carry the pose of a camera on a robot, and are refused when they are wrong."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import PoseQuery, TrackedFrame
from client_sdk.mapper import Mapper
from client_sdk.wheel_odometry import OdometryReading
from rse_pf.errors import Busy, UsageError
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import STEP_M, foreign, frame_at
from tests.kit.wheeled_drives import (
    T_BASE_CAMERA,
    WheeledDrive,
    base_errors_m,
    covered,
    make_drive,
    track_with_wheels,
    wheels_error_m,
)

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

MOUNT = np.eye(4)
MOUNT[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
MOUNT[2, 3] = 0.5


@functools.cache
def short_drive(**options: Any) -> WheeledDrive:
    return make_drive(60, **options)


def sources(tracked: list[TrackedFrame]) -> list[str]:
    return [each.pose_source for each in tracked]


def deviation_m(tracked: TrackedFrame) -> float:
    """Return the standard deviation of the position of the base."""
    assert tracked.pose_covariance is not None
    return math.sqrt(np.trace(tracked.pose_covariance[:3, :3]))


@functools.cache
def without_wheels() -> list[TrackedFrame]:
    mapper = Mapper(ask=solve, T_base_camera=T_BASE_CAMERA)
    return track_with_wheels(mapper, covered(short_drive(), 52, 55), has_wheels=False)


def sideways(row: int) -> OdometryReading:
    """Return where a base is whose camera, which looks ahead, moves to its right."""
    T_odom_base = np.eye(4)
    T_odom_base[:2, 3] = 7.0, 3.0 - STEP_M * row
    return OdometryReading(timestamp_s=row / 10, T_odom_base=T_odom_base)


@pytest.mark.parametrize(
    ("stamp_s", "pose"), [(math.nan, np.eye(4)), (0.0, 2.0 * np.eye(4)), (0.0, np.eye(3))]
)
def test_a_reading_that_is_no_pose_at_a_time_is_refused(stamp_s: float, pose: Any) -> None:
    with pytest.raises(UsageError) as refused:
        OdometryReading(timestamp_s=stamp_s, T_odom_base=pose)

    assert refused.value.hint


async def test_readings_without_a_mount_or_back_in_time_are_refused_and_change_nothing() -> None:
    without = Mapper(ask=solve)
    with pytest.raises(UsageError) as refused:
        await without.track(frame_at(0, depth=True), odometry=[sideways(0)])
    assert refused.value.hint
    assert without.frames == 0

    mapper = Mapper(ask=solve, T_base_camera=MOUNT)
    await mapper.track(frame_at(2, depth=True), odometry=[sideways(1), sideways(2)])
    with pytest.raises(UsageError):
        await mapper.track(frame_at(3, depth=True), odometry=[sideways(1)])
    assert (await mapper.track(frame_at(3, depth=True), odometry=[sideways(2), sideways(3)])).status


async def test_the_world_is_the_frame_of_the_base_at_the_first_image() -> None:
    mapper = Mapper(ask=solve, T_base_camera=MOUNT)

    first = await mapper.track(frame_at(0, depth=True))
    second = await mapper.track(frame_at(3, depth=True))

    assert first.T_world_base == pytest.approx(np.eye(4), abs=1e-9)
    assert second.T_world_base is not None
    assert second.T_world_base[:3, 3] == pytest.approx((0.0, -3 * STEP_M, 0.0), abs=0.01)
    assert second.pose_source == "visual"


async def test_a_planar_base_stays_in_its_plane_and_needs_a_mount() -> None:
    with pytest.raises(UsageError) as refused:
        Mapper(ask=solve, planar=True)
    assert refused.value.hint

    mapper = Mapper(ask=solve, T_base_camera=MOUNT, planar=True)
    tracked = [await mapper.track(frame_at(row, depth=True)) for row in range(6)]

    poses = np.array([each.T_world_base for each in tracked])
    np.testing.assert_allclose(poses[:, 2], np.tile([0.0, 0.0, 1.0, 0.0], (6, 1)), atol=1e-12)
    np.testing.assert_allclose(poses[:, 1, 3], -STEP_M * np.arange(6), atol=0.01)


def test_a_covered_lens_is_carried_by_the_wheels_and_seen_again_at_once() -> None:
    drive = covered(short_drive(), 20, 40)
    mapper = Mapper(ask=solve, T_base_camera=T_BASE_CAMERA)

    done = track_with_wheels(mapper, drive)

    assert sources(done[:40]) == ["visual"] * 20 + ["odometry"] * 20
    assert {each.status for each in done[20:40]} == {"odometry"}
    assert all(each.reason for each in done[20:40])
    assert sources(done[50:]) == ["visual"] * 10
    errors_m = base_errors_m(done, drive)
    assert errors_m[39] - errors_m[19] <= 1.2 * wheels_error_m(drive, 19, 39) + 0.01
    deviations_m = list(map(deviation_m, done))
    assert deviations_m[20:40] == sorted(deviations_m[20:40])
    assert errors_m[39] <= 3.0 * deviations_m[39]
    # The carried poses are neither in the trajectory nor in the map.
    assert not np.isin(mapper.trajectory.timestamps_s, [each.frame.timestamp_s for each in done[20:40]]).any()
    assert mapper.lost_frames >= 20


def test_a_segment_after_a_long_loss_is_in_the_world_of_the_first_one() -> None:
    drive = covered(make_drive(80), 15, 65)
    mapper = Mapper(ask=solve, T_base_camera=T_BASE_CAMERA, keyframes_of="r")
    alone = Mapper(ask=solve, T_base_camera=T_BASE_CAMERA)

    done = track_with_wheels(mapper, drive)
    without = track_with_wheels(alone, drive, has_wheels=False)

    assert without[-1].reason
    assert (done[-1].segment, done[-1].reason, done[-1].pose_source) == (1, "", "visual")
    assert mapper.report()["frames_apart"] == 0
    assert mapper.trajectory.timestamps_s[-1] == done[-1].frame.timestamp_s
    assert len(mapper.map) > 1.2 * len(alone.map)
    error_m = base_errors_m(done, drive)[-1]
    assert error_m < 0.3 * base_errors_m(without, drive)[-1]
    assert error_m <= 3.0 * deviation_m(done[-1])
    assert mapper.encoded_map()


def test_a_place_that_looks_like_an_earlier_one_is_not_recognised_where_the_wheels_cannot_be() -> None:
    drive = covered(short_drive(), 15, 50)
    twin = replace(drive.frames[50], rgb=drive.frames[2].rgb, depth_m=drive.frames[2].depth_m)
    drive = replace(drive, frames=[*drive.frames[:50], twin])

    done = track_with_wheels(Mapper(ask=solve, T_base_camera=T_BASE_CAMERA), drive)
    alone = track_with_wheels(Mapper(ask=solve, T_base_camera=T_BASE_CAMERA), drive, has_wheels=False)

    assert base_errors_m(alone, drive)[-1] > 1.0
    assert done[-1].pose_source == "odometry"
    assert base_errors_m(done, drive)[-1] < 0.2


async def test_a_robot_that_is_carried_while_its_wheels_stand_is_not_taken_for_where_it_was() -> None:
    mapper = Mapper(ask=solve, T_base_camera=MOUNT)
    for row in range(20):
        await mapper.track(frame_at(row, depth=True), odometry=[sideways(row)])

    # An unknown place, along which the robot drives after a while, and then the known one.
    away = [(foreign(frame_at(40, depth=True)), 19)] * 15
    away += [(foreign(frame_at(40 - n, depth=True)), 19 + n) for n in range(15)]
    back = [(frame_at(5, depth=True), 33)] * 10
    tracked = []
    for n, (shown, driven) in enumerate(away + back, 20):
        reading = OdometryReading(timestamp_s=n / 10, T_odom_base=sideways(driven).T_odom_base)
        tracked.append(await mapper.track(replace(shown, timestamp_s=n / 10), odometry=[reading]))

    assert not [each for each in tracked[: len(away)] if each.pose_source == "visual" and not each.reason]
    last = tracked[-1]
    assert (last.pose_source, last.reason) == ("visual", "")
    assert last.T_world_base is not None
    assert last.T_world_base[:3, 3] == pytest.approx((0.0, -5 * STEP_M, 0.0), abs=0.02)


def test_frames_that_the_platform_does_not_answer_begin_no_segment() -> None:
    drive = short_drive()

    async def ask(query: PoseQuery) -> PoseAnswer:
        if 1.0 <= query.timestamp_s < 4.0:
            raise Busy("the server is busy")
        return await solve(query)

    mapper = Mapper(ask=ask, T_base_camera=T_BASE_CAMERA)

    done = track_with_wheels(mapper, drive)

    assert sources(done[10:40]) == ["odometry"] * 30
    assert {each.segment for each in done[:40]} == {0}
    assert sources(done[-10:]) == ["visual"] * 10


def test_an_image_that_repeats_while_the_wheels_turn_is_carried_and_says_so() -> None:
    drive = short_drive()
    still = [replace(frame, rgb=drive.frames[20].rgb) if 20 <= n < 35 else frame
             for n, frame in enumerate(drive.frames)]  # fmt: skip
    frozen = replace(drive, frames=still)
    mapper = Mapper(ask=solve, T_base_camera=T_BASE_CAMERA)

    done = track_with_wheels(mapper, frozen)

    assert sources(done[21:35]) == ["odometry"] * 14
    assert {each.reason for each in done[21:35]} == {"the image repeats while the wheels turn"}
    assert base_errors_m(done, drive)[:36].max() < 0.1
    assert mapper.odometry_trouble == ""


async def test_an_image_that_repeats_while_the_robot_stands_is_tracked() -> None:
    mapper = Mapper(ask=solve, T_base_camera=MOUNT)
    shown = frame_at(0, depth=True)

    done = [
        await mapper.track(
            replace(shown, timestamp_s=row / 10), odometry=[replace(sideways(0), timestamp_s=row / 10)]
        )
        for row in range(5)
    ]

    assert sources(done) == ["visual"] * 5


@pytest.mark.parametrize(
    "fault",
    [{"scale": 1.2}, {"left": 0.0}, {"late_s": 0.1}, {"frozen_after_s": 0.0}],
    ids=["scale", "blocked wheel", "late stamps", "frozen"],
)
def test_wrong_readings_are_named_within_five_seconds_and_change_no_pose(fault: dict[str, Any]) -> None:
    drive = short_drive()
    wrong = replace(drive, readings=make_drive(60, has_images=False, **fault).readings)
    mapper = Mapper(ask=solve, T_base_camera=T_BASE_CAMERA)

    done, without = track_with_wheels(mapper, covered(wrong, 52, 55)), without_wheels()

    assert mapper.odometry_trouble
    assert sources(done) == sources(without)
    assert np.nanmax(np.abs(base_errors_m(done, drive) - base_errors_m(without, drive))) < 0.02


@pytest.mark.parametrize("seed", range(5))
def test_usual_slip_is_not_named(seed: int) -> None:
    drive = short_drive()
    slipping = replace(drive, readings=make_drive(60, seed=seed, has_images=False).readings)
    mapper = Mapper(ask=solve, T_base_camera=T_BASE_CAMERA)

    track_with_wheels(mapper, slipping)

    assert mapper.odometry_trouble == ""


async def test_wheels_give_one_lens_its_scale_and_carry_it() -> None:
    mapper = Mapper(ask=solve, depth=False, T_base_camera=MOUNT)
    rows = range(40)
    dark = {
        row: replace(frame_at(row, depth=False), rgb=np.zeros((240, 320, 3), np.uint8)) for row in (36, 37)
    }

    done = [
        await mapper.track(dark.get(row) or frame_at(row, depth=False), odometry=[sideways(row)])
        for row in rows
    ]

    assert mapper.scale == "metric, by the first 1 m of odometry"
    assert sources(done[36:]) == ["odometry", "odometry", "visual", "visual"]
    for each in done[36:]:
        assert each.T_world_base is not None
        step_m = STEP_M * each.frame.timestamp_s * 10
        assert each.T_world_base[:3, 3] == pytest.approx((0.0, -step_m, 0.0), abs=0.05)
