"""A robot in a live map: it sends keyframes, applies alignments, and survives faults of both."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client_sdk import connect
from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import Frame, FrontEndOptions, PoseQuery, TrackedFrame, extract
from client_sdk.live import BlockingLiveMapper, Correction, LiveMapper, LiveOptions
from client_sdk.live.keyframe_queue import (
    KeyframeQueue,
    NumberOffset,
    QueuedKeyframe,
    choose_number_offset,
)
from client_sdk.live.keyframe_sender import make_request
from client_sdk.wheel_odometry import OdometryReading
from rse_pf.config import SessionSettings
from rse_pf.errors import BadRequest, Busy, Forbidden, MissingExtra, UsageError
from rse_pf.geometry import exp_se3, inverse
from rse_pf.slam.keyframe import SentKeyframe, decode_keyframe, encode_keyframe, make_features
from rse_pf.slam.localise import PosePrior
from rse_pf.wire import Command, make_codec
from tests.kit.fake_live_map import FakeLiveRobot, alignment, failing, solve
from tests.kit.flat_world import CAMERA, STEP_M, covered, foreign, frame_at

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

QUICK = LiveOptions(leave_s=0.2, bytes_per_s=1e9, segment_after=2, relocalise_s=0.001)
T_MAP_ODOM = exp_se3([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])


def live_map(robot: Any, **options: Any) -> LiveMapper:
    return LiveMapper(robot, "lab", ask=solve, live=QUICK, **options)


async def drive(mapper: LiveMapper, rows: range) -> list[TrackedFrame]:
    return [await mapper.track(frame_at(row, depth=True)) for row in rows]


def times_s(robot: FakeLiveRobot) -> list[float]:
    """Return the times of the keyframes that the map has."""
    return [decode_keyframe(request.keyframe).timestamp_s for request in robot.kept]


async def test_a_keyframe_every_10_cm_is_acknowledged_by_the_map_in_order(robot: FakeLiveRobot) -> None:
    async with live_map(robot) as mapper:
        await drive(mapper, range(9))
        await robot.until(lambda: mapper.keyframes_waiting == 0)

        assert [each.number for each in robot.kept] == [0, 1, 2]
        assert times_s(robot) == [0.0, 0.4, 0.8]  # 4 steps are 12.8 cm
        keyframe = decode_keyframe(robot.kept[2].keyframe)
        np.testing.assert_allclose(keyframe.T_odom_camera[:3, 3], [8 * STEP_M, 0, 0], atol=0.02)
        assert keyframe.camera == CAMERA
        assert 100 < len(keyframe.features) <= QUICK.features
        assert mapper.keyframes == 3
        assert mapper.report()["live"]["keyframes_kept"] == 3
    assert "live-leave" in robot.asked


async def test_keyframes_have_the_strongest_features_wherever_they_are(robot: FakeLiveRobot) -> None:
    def half_faint(row: int) -> Frame:
        """Return a frame whose right half has a quarter of the contrast: weaker features are there, too."""
        frame = frame_at(row, depth=True)
        rgb = frame.rgb.copy()
        rgb[:, 160:] = 128 + rgb[:, 160:] // 4
        return replace(frame, rgb=rgb)

    async with live_map(robot) as mapper:
        await mapper.track(half_faint(0))
        await robot.until(lambda: len(robot.kept) == 1)
    pixels = decode_keyframe(robot.kept[0].keyframe).features.pixels
    spread = extract(half_faint(0), FrontEndOptions()).pixels

    assert (pixels[:, 0] > 160).mean() < 0.1
    assert (spread[:, 0] > 160).mean() > 0.3

    by_robot = connect("ws://127.0.0.1:1/ws").live_map("lab")._mapper._options
    assert by_robot is not None
    assert not by_robot.is_spread


@pytest.mark.parametrize("codec", ["json", "zlib", "bin"])
def test_the_largest_keyframe_takes_at_most_34_kb_in_every_codec(codec: str) -> None:
    rng = np.random.default_rng(0)
    count = LiveOptions().sent_with(codec).features
    features = make_features(
        rng.uniform([0, 0], [640, 480], (count, 2)), rng.uniform(0.3, 8.0, count),
        rng.integers(0, 256, (count, 32), dtype=np.uint8),
    )  # fmt: skip
    keyframe = SentKeyframe(
        timestamp_s=1.8e9 + 0.123456789, T_odom_camera=exp_se3(rng.uniform(-3.0, 3.0, 6)), camera=CAMERA,
        features=features,
    )  # fmt: skip
    queued = QueuedKeyframe(10**6, 999, encode_keyframe(keyframe))
    request = make_request("warehouse", queued, NumberOffset(10**6, 10))

    message = make_codec(codec, SessionSettings()).encode(
        Command(id=10**6, service="live-keyframe", payload=request, deadline_ms=5000.0)
    )

    assert 30_000 < len(message) <= 34_000


async def test_a_correction_is_published_before_a_pose_uses_it(robot: FakeLiveRobot) -> None:
    async with live_map(robot) as mapper:
        received: list[Correction] = []

        async def listen() -> None:
            async for correction in mapper.corrections():
                received.append(correction)
                robot.changed.set()

        listening = asyncio.create_task(listen())
        first, second = await drive(mapper, range(2))
        assert first.T_map_camera is None
        assert not mapper.aligned
        assert mapper.reason
        await robot.until(lambda: len(robot.kept) == 1 and robot.asked[-1] == "live-show")

        robot.publish("alignment/me", alignment("me", T_MAP_ODOM))
        await robot.until(lambda: len(received) == 1)
        third, fourth = await drive(mapper, range(2, 4))

        assert received[0].before is None
        assert received[0].cause == ("other", 3)
        assert received[0].by == "map"
        np.testing.assert_array_equal(received[0].after, T_MAP_ODOM)
        assert (third.corrected, fourth.corrected) == (True, False)
        assert third.T_world_camera is not None
        assert second.T_world_camera is not None
        np.testing.assert_allclose(third.T_map_camera, T_MAP_ODOM @ third.T_world_camera)
        moved_m = np.linalg.norm(third.T_world_camera[:3, 3] - second.T_world_camera[:3, 3])
        assert abs(moved_m - STEP_M) < 0.005  # the odometry frame does not jump
        np.testing.assert_allclose(mapper.covariance, 1e-4 * np.eye(6))
        assert mapper.aligned
        assert mapper.version == 7
        assert len(mapper.map_trajectory) == 4
    await asyncio.wait_for(listening, 5.0)  # it ends with the live map


async def test_others_and_the_state_of_the_map_are_known(robot: FakeLiveRobot) -> None:
    async with live_map(robot) as mapper:
        pose = {"kind": "pose", "robot": "r2", "segment": 0, "timestamp_s": 4.0}
        robot.publish("pose/r2", {**pose, "T_map_camera": T_MAP_ODOM.ravel().tolist()})
        robot.publish("alignment/r3", alignment("r3", None, reason="too few closures"))
        robot.publish("map", {"kind": "map", "keyframes": 9, "version": 12, "owner": "o", "state": "moving"})
        await robot.until(lambda: mapper.state == "moving")

        np.testing.assert_allclose(mapper.others["r2"].T_map_camera, T_MAP_ODOM)
        assert mapper.others["r3"].reason == "too few closures"
        assert (mapper.map_keyframes, mapper.version, mapper.map_server) == (9, 12, "o")

        robot.publish("pose/r2", {"robot": "r2"})  # damaged: reported, and nothing changes
        await robot.until(lambda: "bad-message" in mapper.trouble)
        assert "r2" in mapper.others
        robot.connected = False
        assert mapper.state == "offline"


async def test_keyframes_wait_on_disk_while_offline_and_arrive_once_in_order(
    robot: FakeLiveRobot, tmp_path: Path
) -> None:
    async with live_map(robot, spool=tmp_path) as mapper:
        await drive(mapper, range(1))
        await robot.until(lambda: len(robot.kept) == 1)
        robot.connected = False
        await drive(mapper, range(1, 14))
        assert mapper.keyframes_waiting == 3
        assert len(list((tmp_path / "lab").glob("*.keyframe"))) == 3
        assert mapper.lost_frames == 0

        robot.connected = robot.lose_answer = True
        await robot.until(lambda: mapper.keyframes_waiting == 0)

        assert [each.number for each in robot.kept] == [0, 1, 2, 3]
        assert sorted(times_s(robot)) == [0.0, 0.4, 0.8, 1.2]
        assert not list((tmp_path / "lab").glob("*.keyframe"))


async def test_a_program_that_starts_again_sends_what_waited_and_begins_a_new_segment(
    robot: FakeLiveRobot, tmp_path: Path
) -> None:
    async with live_map(robot, spool=tmp_path) as mapper:
        await drive(mapper, range(1))
        await robot.until(lambda: len(robot.kept) == 1)
        robot.connected = False
        await drive(mapper, range(1, 6))
    assert len(robot.kept) == 1

    robot.connected = True
    async with live_map(robot, spool=tmp_path) as mapper:
        await drive(mapper, range(6, 7))
        await robot.until(lambda: mapper.keyframes_waiting == 0)

        assert [(each.number, each.segment) for each in robot.kept] == [(0, 0), (1, 0), (2, 1)]
        assert mapper.segment == 1
        assert mapper.report()["live"]["segments"] == 1


async def test_a_spool_in_use_is_refused_in_one_line_and_free_again_when_its_program_ends(
    robot: FakeLiveRobot, tmp_path: Path
) -> None:
    async with live_map(robot, spool=tmp_path) as mapper:
        robot.connected = False
        await drive(mapper, range(6))
        left = list((tmp_path / "lab").glob("*.keyframe"))

        with pytest.raises(UsageError, match="another program keeps its keyframes") as refused:
            async with live_map(FakeLiveRobot(), spool=tmp_path):
                pass

        assert refused.value.hint == "give each robot a spool of its own"
        assert list((tmp_path / "lab").glob("*.keyframe")) == left != []
    robot.connected = True
    async with live_map(robot, spool=tmp_path) as mapper:
        await robot.until(lambda: mapper.keyframes_waiting == 0)


def test_the_spool_of_a_program_that_was_killed_is_free(tmp_path: Path) -> None:
    code = (
        "import os, sys; from pathlib import Path\n"
        "from client_sdk.live.keyframe_queue import KeyframeQueue\n"
        "KeyframeQueue(Path(sys.argv[1])).open()\n"
        "os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert (tmp_path / ".lock").exists()

    queue = KeyframeQueue(tmp_path)
    queue.open()
    queue.close()


async def test_a_program_that_starts_again_without_a_spool_asks_for_its_numbers(robot: FakeLiveRobot) -> None:
    for _ in range(2):
        async with live_map(robot) as mapper:
            await drive(mapper, range(6))
            await robot.until(lambda mapper=mapper: mapper.keyframes_waiting == 0)

    assert [(each.number, each.segment) for each in robot.kept] == [(0, 0), (1, 0), (2, 1), (3, 1)]


async def test_a_map_that_was_started_again_gets_new_numbers_and_ends_old_alignments(
    robot: FakeLiveRobot,
) -> None:
    async with live_map(robot) as mapper:
        await drive(mapper, range(5))
        await robot.until(lambda: len(robot.kept) == 2)
        robot.publish("alignment/me", alignment("me", T_MAP_ODOM))
        await robot.until(lambda: mapper.aligned)

        robot.restart_map()
        await mapper.track(foreign(frame_at(5, depth=True)))
        await mapper.track(foreign(frame_at(6, depth=True)))
        (again,) = await drive(mapper, range(7, 8))
        await robot.until(lambda: mapper.keyframes_waiting == 0)

        assert again.segment == 1
        assert [(each.number, each.segment) for each in robot.kept] == [(0, 0)]
        robot.publish("alignment/me", alignment("me", T_MAP_ODOM, segment=0))
        await robot.until(lambda: mapper.aligned)
        assert len(mapper.map_trajectory) == 1  # the first segment was of the old map


async def test_a_failed_relocalisation_is_reported_until_the_robot_is_aligned(
    robot: FakeLiveRobot,
) -> None:
    robot.foreign_keyframes = 50
    robot.before_answer = failing(MissingExtra("gtsam", "maps"), "live-relocalise", 1000)
    async with live_map(robot) as mapper:
        await drive(mapper, range(3))
        await robot.until(lambda: "live-relocalise" in robot.asked)
        await drive(mapper, range(3, 5))
        assert mapper.trouble == "missing-extra: gtsam is not installed: it is in the extra 'maps'"

        robot.publish("alignment/me", alignment("me", T_MAP_ODOM))
        await robot.until(lambda: mapper.aligned)
        assert not mapper.trouble


async def test_a_lost_robot_begins_a_segment_and_is_relocalised(robot: FakeLiveRobot) -> None:
    robot.foreign_keyframes = 50
    T_map_camera = exp_se3([5.0, 0, 0, 0, 0, 0])
    async with live_map(robot) as mapper:
        await drive(mapper, range(3))
        await robot.until(lambda: "live-relocalise" in robot.asked)
        assert mapper.reason == "not relocalised: nothing alike"

        robot.relocalised = {
            "verdict": "ok",
            "T_map_camera": T_map_camera.ravel().tolist(),
            "inliers": 80,
        }
        assert [(await mapper.track(foreign(frame_at(row, depth=True)))).status for row in (3, 4)] == [
            "lost",
            "lost",
        ]
        before = mapper.trajectory.T_world_camera[-1]
        (found,) = await drive(mapper, range(5, 6))
        assert found.segment == 1
        assert not found.lost
        np.testing.assert_allclose(found.T_world_camera, before)
        await robot.until(lambda: mapper.aligned)

        (placed,) = await drive(mapper, range(6, 7))
        assert mapper.aligned_by == "relocalisation"
        assert placed.T_map_camera is not None
        np.testing.assert_allclose(placed.T_map_camera[:3, 3], [5 + STEP_M, 0, 0], atol=0.01)

        robot.publish("alignment/me", alignment("me", None, segment=1, reason="too few closures"))
        robot.publish("alignment/me", alignment("me", T_MAP_ODOM, segment=1))
        await robot.until(lambda: mapper.aligned_by == "map")  # what the map found wins


async def test_wheels_carry_the_pose_in_the_map_until_the_next_segment_is_aligned(
    robot: FakeLiveRobot,
) -> None:
    T_base_camera = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])

    def wheels(row: int) -> list[OdometryReading]:
        T_odom_base = exp_se3([0.0, -STEP_M * row, 0, 0, 0, 0])
        return [OdometryReading(timestamp_s=row / 10, T_odom_base=T_odom_base)]

    async with live_map(robot, T_base_camera=T_base_camera) as mapper:
        for row in range(3):
            await mapper.track(frame_at(row, depth=True), odometry=wheels(row))
        await robot.until(lambda: len(robot.kept) == 1 and robot.asked[-1] == "live-show")
        robot.publish("alignment/me", alignment("me", T_MAP_ODOM))
        await robot.until(lambda: mapper.aligned)

        lost = await mapper.track(covered(frame_at(3, depth=True)), odometry=wheels(3))
        rows = range(4, 12)
        later = [await mapper.track(foreign(frame_at(row, depth=True)), odometry=wheels(row)) for row in rows]

        assert (lost.status, lost.pose_source) == ("odometry", "odometry")
        assert (later[-1].segment, later[-1].pose_source, mapper.aligned) == (1, "visual", False)
        begun = next(each for each in later if each.segment == 1)
        for each in (lost, begun):
            assert each.T_map_camera is not None
            row = 10 * each.frame.timestamp_s
            expected = T_MAP_ODOM @ exp_se3([0.0, -STEP_M * row, 0, 0, 0, 0]) @ T_base_camera
            np.testing.assert_allclose(each.T_map_camera, expected, atol=0.01)
        assert lost.frame.timestamp_s not in mapper.map_trajectory.timestamps_s

        robot.publish("alignment/me", alignment("me", np.eye(4), segment=1))
        await robot.until(lambda: mapper.aligned)
        aligned = await mapper.track(foreign(frame_at(12, depth=True)), odometry=wheels(12))
        assert aligned.corrected
        np.testing.assert_allclose(aligned.T_map_camera, aligned.T_world_camera)


async def test_relocalise_sends_the_next_keyframe_without_a_pause(robot: FakeLiveRobot) -> None:
    robot.foreign_keyframes = 50
    patient = replace(QUICK, relocalise_s=3600.0, keyframe_m=0.01)
    async with LiveMapper(robot, "lab", ask=solve, live=patient) as mapper:
        await drive(mapper, range(2))
        await robot.until(lambda: "live-relocalise" in robot.asked)
        await drive(mapper, range(2, 4))
        await robot.until(lambda: len(robot.kept) == 4)
        assert robot.asked.count("live-relocalise") == 1
        mapper.relocalise()
        await drive(mapper, range(4, 5))
        await robot.until(lambda: robot.asked.count("live-relocalise") == 2)


async def test_a_prior_moves_with_the_odometry_until_the_robot_is_localised(robot: FakeLiveRobot) -> None:
    robot.foreign_keyframes = 50
    T_expected = exp_se3([7.0, 2.0, 0.0, 0.0, 0.0, 1.0])
    prior = PosePrior(T_map_camera=T_expected, covariance=np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 0.068]))
    patient = replace(QUICK, relocalise_s=3600.0, keyframe_m=0.01)
    async with LiveMapper(robot, "lab", ask=solve, live=patient) as mapper:
        (before,) = await drive(mapper, range(1))
        await robot.until(lambda: len(robot.priors) == 1)
        robot.relocalised = {"verdict": "ok", "T_map_camera": T_MAP_ODOM.ravel().tolist(), "inliers": 20}
        mapper.relocalise(prior)
        (after,) = await drive(mapper, range(1, 2))
        await robot.until(lambda: mapper.aligned)
        mapper.relocalise()
        await drive(mapper, range(2, 3))
        mapper.relocalise(prior)  # the relocalisation was wrong
        await drive(mapper, range(3, 4))
        await robot.until(lambda: len(robot.priors) == 3)

    none, first, again = robot.priors
    assert none is None
    assert first is not None
    assert again is not None
    assert before.T_world_camera is not None
    moved = T_expected @ inverse(before.T_world_camera) @ after.T_world_camera
    np.testing.assert_allclose(np.reshape(first.T_map_camera, (4, 4)), moved, atol=1e-9)
    assert [number for number in first.covariance if number] == [0.25, 0.25, 0.068]


async def test_a_covered_lens_begins_no_segment_and_tracking_continues_after_it(
    robot: FakeLiveRobot,
) -> None:
    async with live_map(robot) as mapper:
        await drive(mapper, range(6))
        dark = [await mapper.track(covered(frame_at(row, depth=True))) for row in range(6, 16)]
        back = await mapper.track(replace(frame_at(2, depth=True), timestamp_s=16.0))

        assert {tracked.status for tracked in dark} == {"lost"}
        assert (back.status, back.segment) == ("tracked", 0)
        np.testing.assert_allclose(back.T_world_camera[:3, 3], [2 * STEP_M, 0, 0], atol=0.02)


async def test_relocalisations_without_a_place_become_less_frequent_until_the_next_segment(
    robot: FakeLiveRobot,
) -> None:
    robot.foreign_keyframes = 50
    async with live_map(robot) as mapper:
        for row in range(30):
            if mapper._relocaliser.verdicts["none"] == 6:
                break
            assert mapper._relocaliser.pause_s == QUICK.relocalise_s
            await drive(mapper, range(row, row + 1))
            task = mapper._relocaliser.task
            await robot.until(lambda: task is None or task.done())  # noqa: B023
        assert mapper._relocaliser.pause_s == 4 * QUICK.relocalise_s
        mapper._begin_segment()
        assert mapper._relocaliser.pause_s == QUICK.relocalise_s


async def test_an_ambiguous_place_ends_a_relocalisation(robot: FakeLiveRobot) -> None:
    robot.foreign_keyframes = 50
    robot.relocalised = {"verdict": "ok", "T_map_camera": np.eye(4).ravel().tolist()}
    async with live_map(robot) as mapper:
        await drive(mapper, range(1))
        await robot.until(lambda: mapper.aligned)
        robot.publish("alignment/me", alignment("me", None, reason="ambiguous: two places look alike"))
        await robot.until(lambda: not mapper.aligned)

        assert mapper.reason == "ambiguous: two places look alike"


async def test_a_busy_map_gets_the_keyframe_again_and_a_refused_one_leaves_no_gap(
    robot: FakeLiveRobot,
) -> None:
    async with live_map(robot) as mapper:
        robot.before_answer = failing(Busy("moving", retry_after_ms=1.0), "live-keyframe", 1)
        await drive(mapper, range(1))
        await robot.until(lambda: len(robot.kept) == 1)
        robot.before_answer = failing(BadRequest("malformed keyframe"), "live-keyframe", 1)
        await drive(mapper, range(1, 9))
        await robot.until(lambda: mapper.keyframes_waiting == 0)

        assert [(each.number, each.segment) for each in robot.kept] == [(0, 0), (1, 0)]
        assert times_s(robot) == [0.0, 0.8]
        assert mapper.report()["live"]["keyframes_refused"] == 1


async def test_a_robot_without_the_scope_gets_the_error_when_it_joins(robot: FakeLiveRobot) -> None:
    robot.before_answer = failing(Forbidden("no scope maps:live/lab"), "live-show", 1)
    with pytest.raises(Forbidden, match="maps:live/lab"):
        async with live_map(robot):
            pass


async def test_a_keyframe_waits_while_a_pose_query_is_open(robot: FakeLiveRobot) -> None:
    order: list[str] = []
    asked, answer = asyncio.Event(), asyncio.Event()

    async def slow(query: PoseQuery) -> PoseAnswer:
        asked.set()
        await answer.wait()
        order.append("pose")
        return await solve(query)

    async with LiveMapper(robot, "lab", ask=slow, live=QUICK) as mapper:
        robot.connected = False
        await mapper.track(frame_at(0, depth=True))
        await robot.until(lambda: "expired" in mapper.trouble)
        tracking = asyncio.create_task(mapper.track(frame_at(1, depth=True)))
        await asked.wait()
        robot.before_answer = order.append
        robot.connected = True
        asyncio.get_running_loop().call_later(0.5, answer.set)  # the keyframe would be sent by then
        await robot.until(lambda: len(robot.kept) == 1)
        await tracking

    assert order[:2] == ["pose", "live-keyframe"]


def test_a_program_without_asyncio_uses_the_same_mapper() -> None:
    loop = asyncio.new_event_loop()
    robot = FakeLiveRobot()
    try:
        with BlockingLiveMapper(live_map(robot), loop.run_until_complete) as blocking:
            blocking.track(frame_at(0, depth=True))
            loop.run_until_complete(robot.until(lambda: len(robot.kept) == 1))
            robot.publish("alignment/me", alignment("me", T_MAP_ODOM))
            corrections = blocking.corrections()
            assert next(corrections).by == "map"
            assert blocking.track(frame_at(1, depth=True)).corrected
        assert list(corrections) == []  # they end with the live map
    finally:
        loop.close()


async def test_a_map_that_is_not_joined_is_refused(robot: FakeLiveRobot) -> None:
    mapper = live_map(robot)
    with pytest.raises(UsageError, match="not joined"):
        await mapper.track(frame_at(0, depth=True))


def test_a_small_spool_opens_empty_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    queue = KeyframeQueue(tmp_path, max_bytes=10)
    queue.open()
    assert queue.next_index == 0
    assert not len(queue)
    queue.close()
    (tmp_path / "000000000000.keyframe").write_bytes(b"no keyframe")
    with pytest.raises(UsageError, match="cannot use the keyframes in"):
        KeyframeQueue(tmp_path).open()


@pytest.mark.parametrize(
    ("current", "next_number", "unused_segment", "expected"),
    [
        # never asked before: index 4 of segment 1 becomes keyframe 7 of segment 2
        (None, 7, 2, (NumberOffset(3, 1), 0)),
        # the map expects the oldest queued keyframe
        (NumberOffset(0, 0), 4, 3, (NumberOffset(0, 0), 0)),
        # two acknowledgements were lost
        (NumberOffset(0, 0), 6, 3, (NumberOffset(0, 0), 2)),
        # the map was started again
        (NumberOffset(0, 0), 0, 0, (NumberOffset(-4, -1), 0)),
        # the map has more keyframes than this robot has sent
        (NumberOffset(0, 0), 10, 5, (NumberOffset(6, 4), 0)),
    ],
)
def test_numbers_follow_what_the_map_expects(
    current: NumberOffset | None, next_number: int, unused_segment: int, expected: tuple[NumberOffset, int]
) -> None:
    chosen = choose_number_offset(
        current,
        first_index=4,
        first_segment=1,
        next_index=9,
        next_number=next_number,
        unused_segment=unused_segment,
    )

    assert chosen == expected
