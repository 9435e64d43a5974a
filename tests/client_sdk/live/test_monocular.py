"""A monocular robot in a live map: it sends settled keyframes, and receives its metric scale."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from client_sdk.frontend import Frame, TrackedFrame
from client_sdk.live import LiveMapper, LiveOptions
from client_sdk.live.monocular_odometry import MonocularOdometry
from client_sdk.simulator.renderer import add_image_noise
from client_sdk.tracking.monocular_segment import AdjustedKeyframe
from rse_pf.errors import UsageError
from rse_pf.geometry import Array, exp_se3, inverse, pose_difference, scaled
from rse_pf.slam.keyframe import decode_keyframe
from rse_pf.slam.tracking import Features
from tests.kit.fake_live_map import FakeLiveRobot, alignment, solve
from tests.kit.flat_world import DEPTHS_M, STEP_M, foreign, frame_at
from tests.kit.shared_map import SharedMap

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

LIVE = LiveOptions(leave_s=0.2, bytes_per_s=1e9, relocalise_s=0.001)
T_MAP_ODOM = exp_se3([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])


def live_map(robot: Any) -> LiveMapper:
    return LiveMapper(robot, "lab", ask=solve, live=LIVE)


def lens(row: int, stamp_s: float | None = None) -> Frame:
    frame = frame_at(row, depth=False)
    return frame if stamp_s is None else replace(frame, timestamp_s=stamp_s)


async def drive(mapper: LiveMapper, rows: range) -> list[TrackedFrame]:
    return [await mapper.track(lens(row)) for row in rows]


async def test_settled_monocular_keyframes_are_sent_with_one_scale(robot: FakeLiveRobot) -> None:
    async with live_map(robot) as mapper:
        done = await drive(mapper, range(24))
        await robot.until(lambda: mapper.keyframes_waiting == 0)
        tracker = mapper._mapper.monocular_tracker
        assert tracker is not None
        assert len(robot.kept) == mapper.keyframes == tracker.segment_keyframes - 2 > 5

    assert {each.status for each in done} == {"starting", "tracked"}
    assert {each.scale for each in done} == {"up to scale"}
    assert [each.number for each in robot.kept] == list(range(len(robot.kept)))
    sent = [decode_keyframe(each.keyframe) for each in robot.kept]
    assert sent[0].timestamp_s == 0.0
    moved_m = 10.0 * STEP_M * np.array([each.timestamp_s for each in sent])
    positions = np.array([each.T_odom_camera[:3, 3] for each in sent])
    unit_m = moved_m[-1] / np.linalg.norm(positions[-1] - positions[0])
    np.testing.assert_allclose(unit_m * positions, np.outer(moved_m, [1, 0, 0]), atol=0.02)
    for each in sent:
        assert not each.features.is_metric
        assert 100 < len(each.features) <= LIVE.features
        band = np.clip(each.features.pixels[:, 1] / 80, 0, 2).astype(int)
        known = each.features.depths_m > 0
        true_m = np.array(DEPTHS_M)[band]
        ratios = each.features.depths_m[known] / true_m[known]
        assert known.sum() > 50
        assert abs(unit_m * np.median(ratios) - 1.0) < 0.1  # the tracker's own unit drifts by 6 %


async def test_monocular_poses_are_metric_once_the_map_has_sent_the_scale(
    robot: FakeLiveRobot,
) -> None:
    async with live_map(robot) as mapper:
        before = (await drive(mapper, range(14)))[-1]
        assert (before.T_map_camera, mapper.metres_per_unit) == (None, None)
        assert mapper.scale == "up to scale"
        await robot.until(lambda: mapper.keyframes_waiting == 0 and robot.asked.count("live-show") > 1)
        robot.publish("alignment/me", alignment("me", None, reason="up to scale: alone"))
        await robot.until(lambda: mapper.reason == "up to scale: alone")

        robot.publish("alignment/me", alignment("me", T_MAP_ODOM, scale=0.25))
        await robot.until(lambda: mapper.aligned)
        one, two = await drive(mapper, range(14, 16))

        assert (one.corrected, two.corrected) == (True, False)
        assert (mapper.scale, mapper.metres_per_unit) == ("metric, by the live map", 0.25)
        assert not mapper.reason
        for each in (one, two):
            assert each.T_world_camera is not None
            np.testing.assert_allclose(each.T_map_camera, T_MAP_ODOM @ scaled(each.T_world_camera, 0.25))
        assert (
            len(mapper.map_trajectory)
            == sum(each.T_world_camera is not None for each in (before, one, two)) + len(mapper._poses) - 3
        )
        assert mapper.report()["live"]["metres_per_unit"] == 0.25


async def test_a_first_frame_without_the_depth_that_was_promised_is_refused(robot: FakeLiveRobot) -> None:
    async with LiveMapper(robot, "lab", ask=solve, live=LIVE, depth=True) as mapper:
        with pytest.raises(UsageError, match="the first frame has no depth"):
            await mapper.track(lens(0))
        assert (await mapper.track(frame_at(0, depth=True))).status == "first"
        assert mapper.scale == "metric, by depth"
    async with LiveMapper(robot, "lab", ask=solve, live=LIVE, depth=False) as mapper:
        assert (await mapper.track(frame_at(0, depth=True))).status == "starting"


async def test_a_tracker_that_changes_its_scale_changes_no_sent_keyframe(
    robot: FakeLiveRobot,
) -> None:
    async with live_map(robot) as mapper:
        done = await drive(mapper, range(14))
        tracker = mapper._mapper.monocular_tracker
        assert tracker is not None
        tracker.rescale(0.3)  # as an IMU does
        done += await drive(mapper, range(14, 18))
        await robot.until(lambda: mapper.keyframes_waiting == 0)
    x = [each.T_world_camera[0, 3] for each in done if each.T_world_camera is not None]
    steps = np.diff(x)
    assert steps.min() > 0.7 * steps.max()
    sent = [decode_keyframe(each.keyframe) for each in robot.kept]
    depths = [np.median(each.features.depths_m[each.features.depths_m > 0]) for each in sent]
    assert min(depths) > 0.8 * max(depths)


async def test_another_segment_has_no_metric_scale_until_the_map_has_sent_one(robot: FakeLiveRobot) -> None:
    async with live_map(robot) as mapper:
        await drive(mapper, range(14))
        await robot.until(lambda: mapper.keyframes_waiting == 0 and robot.asked.count("live-show") > 1)
        robot.publish("alignment/me", alignment("me", T_MAP_ODOM, scale=0.25))
        await robot.until(lambda: mapper.aligned)

        elsewhere = [await mapper.track(foreign(lens(row, 5.0 + row / 10))) for row in range(24)]
        await robot.until(lambda: mapper.keyframes_waiting == 0)

        first = next(each for each in elsewhere if each.T_world_camera is not None)
        assert (first.segment, mapper.segment, mapper.scale) == (1, 1, "up to scale")
        assert mapper.metres_per_unit is None
        assert all(each.T_map_camera is None for each in elsewhere)
        segments = [each.segment for each in robot.kept]
        assert segments == sorted(segments)
        assert set(segments) == {0, 1}
        times_s = [decode_keyframe(each.keyframe).timestamp_s for each in robot.kept]
        assert segments == [int(stamp_s >= 5.0) for stamp_s in times_s]

        robot.publish("alignment/me", alignment("me", np.eye(4), segment=1, scale=3.0))
        await robot.until(lambda: mapper.aligned)
        last = await mapper.track(foreign(lens(24, 7.4)))
        assert last.corrected
        assert last.T_world_camera is not None
        np.testing.assert_allclose(last.T_map_camera, scaled(last.T_world_camera, 3.0))


async def test_monocular_keyframes_are_relocalised_with_the_scale_of_the_reply(robot: FakeLiveRobot) -> None:
    robot.foreign_keyframes = 5
    T_map_camera = exp_se3([0.3, 0.1, 0.2, 0.0, 0.1, 0.0])
    robot.relocalised = {"verdict": "ok", "T_map_camera": T_map_camera.ravel().tolist(), "scale": 0.5}
    async with live_map(robot) as mapper:
        await drive(mapper, range(14))
        await robot.until(lambda: mapper.aligned)

        assert (mapper.aligned_by, mapper.metres_per_unit) == ("relocalisation", 0.5)
        [asked, *_] = [decode_keyframe(each.keyframe) for each in robot.kept]
        expected = T_map_camera @ inverse(scaled(asked.T_odom_camera, 0.5))
        np.testing.assert_allclose(mapper.T_map_odom, expected)


class MovingTracker:
    """A tracker whose keyframes the test moves; one metre is ``unit`` units of length."""

    def __init__(self) -> None:
        self.segment, self.length_factor = 0, 1.0
        self.joins: list[Any] = []
        self.loop_scales: list[float] = []
        self.poses: list[Array] = []

    @property
    def segment_keyframes(self) -> int:
        return len(self.poses)

    def keyframe_pose(self, number: int) -> Array:
        return self.poses[number]

    def keyframe(self, number: int) -> AdjustedKeyframe:
        none = np.empty((0, 2))
        image = Features(
            pixels=none, descriptors=np.empty((0, 32), np.uint8), orientations=none, sizes=none[:, 0],
            points_camera=np.empty((0, 3)), distinctiveness=none[:, 0],
        )  # fmt: skip
        return AdjustedKeyframe(
            timestamp_s=float(number), T_world_camera=self.poses[number], features=image,
            depths=np.array([2.0 * self.length_factor, np.nan]),
        )  # fmt: skip

    def rescale(self, scale: float) -> None:
        self.poses = [scaled(pose, scale) for pose in self.poses]
        self.length_factor *= scale

    def turn(self, T: Array) -> None:
        """Adjust all keyframes: they move together."""
        self.poses = [T @ pose for pose in self.poses]


def at(x: float) -> Array:
    return exp_se3([x, 0.0, 0.0, 0.0, 0.1 * x, 0.0])


def test_an_odometry_keeps_its_unit_and_its_sent_poses_through_adjustments() -> None:
    tracker: Any = MovingTracker()
    odometry, sent = MonocularOdometry(tracker), []
    for number in range(8):
        tracker.poses.append(scaled(at(number), tracker.length_factor))
        if number == 3:
            tracker.rescale(0.2)
        if number == 5:
            tracker.turn(exp_se3([0.0, 0.3, 0.0, 0.0, 0.0, 0.4]))
            moved = tracker.poses
        if number > 5:
            tracker.poses[-1] = exp_se3([0.0, 0.3, 0.0, 0.0, 0.0, 0.4]) @ tracker.poses[-1]
        assert not odometry.start_if_broken()
        sent += odometry.take_settled()
        assert len(sent) == max(0, number - 1)  # two newer ones exist
        np.testing.assert_allclose(odometry.pose_in_odometry(tracker.poses[-1]), at(number), atol=1e-9)

    assert moved is not None
    for number, (seen, T_odom_camera) in enumerate(sent):
        np.testing.assert_allclose(T_odom_camera, at(number), atol=1e-9)
        np.testing.assert_allclose(seen.depths, [2.0, np.nan])


@pytest.mark.parametrize(("scale", "begins"), [(1.02, False), (1 / 1.02, False), (1.05, True), (0.9, True)])
def test_a_loop_closure_that_changes_the_scale_ends_an_odometry(scale: float, begins: bool) -> None:
    tracker: Any = MovingTracker()
    odometry = MonocularOdometry(tracker)
    tracker.poses = [at(number) for number in range(5)]
    assert not odometry.start_if_broken()
    sent = list(odometry.take_settled())
    tracker.rescale(scale)
    tracker.loop_scales.append(scale)

    assert odometry.start_if_broken() == begins
    assert not list(odometry.take_settled())
    newest = odometry.pose_in_odometry(tracker.poses[-1])
    moved = pose_difference(newest, at(4))[0]
    assert math.isclose(moved, 4.0 * abs(scale - 1.0) if begins else 0.0, rel_tol=0.01, abs_tol=1e-9)
    assert len(sent) == 3


def test_an_older_segment_continues_with_its_next_keyframes() -> None:
    tracker: Any = MovingTracker()
    odometry = MonocularOdometry(tracker)
    old = tracker.poses = [at(number) for number in range(5)]
    assert not odometry.start_if_broken()
    assert len(list(odometry.take_settled())) == 3
    tracker.segment, tracker.poses, tracker.length_factor = 1, [at(0.0), at(1.0), at(2.0)], 7.0
    assert odometry.start_if_broken()
    [(first, T_odom_camera)] = odometry.take_settled()
    assert first.timestamp_s == 0.0
    np.testing.assert_allclose(first.depths, [14.0, np.nan])  # it begins in the unit of now
    np.testing.assert_allclose(T_odom_camera, at(0.0))
    np.testing.assert_allclose(odometry.pose_in_odometry(at(2.0)), at(2.0), atol=1e-9)
    assert not odometry.start_if_broken()

    tracker.segment, tracker.poses, tracker.length_factor = 0, old, 1.0
    assert odometry.start_if_broken()
    assert not list(odometry.take_settled())
    tracker.poses += [at(5.0), at(6.0), at(7.0)]
    assert [seen.timestamp_s for seen, _ in odometry.take_settled()] == [5.0]
    tracker.joins.append(None)
    assert odometry.start_if_broken()


async def test_a_monocular_robot_gets_its_scale_within_3_percent_from_a_robot_with_depth() -> None:
    """Two robots drive the same way; the monocular robot is three frames ahead."""
    count, ahead = 22, 3

    def noisy(row: int, *, depth: bool) -> Frame:
        frame = frame_at(row, depth=depth)
        rng = np.random.default_rng([row, depth])
        return replace(frame, rgb=add_image_noise(frame.rgb.astype(np.float32), rng))

    shared = SharedMap()
    robots = [shared.robot(name) for name in ("depth", "lens")]
    async with live_map(robots[0]) as metric, live_map(robots[1]) as mapper:
        for row in range(count):
            for robot, each, frame in (
                (robots[0], metric, noisy(row, depth=True)),
                (robots[1], mapper, noisy(row + ahead, depth=False)),
            ):
                done = await each.track(frame)
                await robot.until(lambda each=each: each.keyframes_waiting == 0)  # type: ignore[misc]
        await robots[1].until(lambda: mapper.aligned and mapper.aligned_by == "map")
        done = await mapper.track(noisy(count + ahead, depth=False))

        assert (mapper.scale, metric.scale) == ("metric, by the live map", "metric, by depth")
        assert metric.metres_per_unit == 1.0
        assert done.T_map_camera is not None
        np.testing.assert_allclose(done.T_map_camera[:3, 3], [(count + ahead) * STEP_M, 0, 0], atol=0.03)
        path = mapper.map_trajectory
        true_m = 10.0 * STEP_M * (path.timestamps_s[-1] - path.timestamps_s[0])
        length_m = np.linalg.norm(path.positions[-1] - path.positions[0])
        assert abs(length_m / true_m - 1.0) < 0.03
