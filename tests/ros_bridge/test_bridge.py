"""Tests of `ros_bridge.bridge` with a robot that answers by itself: no ROS, no platform."""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from client_sdk.bags.message_types import DIAGNOSTICS, POSE_WITH_COVARIANCE
from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import PoseQuery
from client_sdk.mapper import Mapper
from ros_bridge import BridgeOptions
from ros_bridge.bridge import connected_bridge
from rse_pf.errors import Unauthorized, UsageError
from tests.kit.bridge_runs import MAKER, START_NS, Heard, count_of, drive, running, send
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import frame_at


async def test_poses_are_those_of_the_mapper_with_the_stamps_of_the_images() -> None:
    heard, own = Heard(), Mapper(ask=solve, depth=True)
    async with running(heard) as bridge:
        await drive(bridge, heard, 3)

    poses = heard.of(POSE_WITH_COVARIANCE, MAKER)
    for row in range(3):
        await own.track(frame_at(row, depth=True))
    places = [[each.pose.pose.position.x, each.pose.pose.position.y] for each in poses]
    assert np.allclose(places, own.trajectory.positions[:, :2], atol=2e-3)  # depth is rounded to 1 mm
    stamps = [each.header.stamp.sec * 10**9 + each.header.stamp.nanosec for each in poses]
    assert stamps == [START_NS, START_NS + 100_000_000, START_NS + 200_000_000]


async def test_a_bag_that_is_played_again_is_tracked_again() -> None:
    heard = Heard()
    async with running(heard) as bridge:
        for count, row in enumerate((30, 31, 0, 1), 1):
            send(bridge, frame_at(row % 30, depth=True), row)
            await heard.until(count_of(POSE_WITH_COVARIANCE, count))

    assert bridge.lost_frames == 0


async def test_a_service_saves_the_map_into_the_folder_of_the_options(tmp_path: Path) -> None:
    heard = Heard()
    async with running(heard, out=str(tmp_path / "saved")) as bridge:
        await drive(bridge, heard, 2)
        reply = await bridge.save()

    assert reply.ok
    assert json.loads(reply.reply)["frames"] == 2
    assert {each.name for each in (tmp_path / "saved").iterdir()} == {
        "map.ply", "trajectory.txt", "report.json"
    }  # fmt: skip


async def test_diagnostics_count_what_was_left_out_and_say_why() -> None:
    heard = Heard()
    async with running(heard) as bridge:
        await drive(bridge, heard, 1)
        bridge.receive("colour", b"broken")
        heard.messages.clear()
        await heard.until(count_of(DIAGNOSTICS, 1))

    status = heard.of(DIAGNOSTICS, MAKER)[-1].status[0]
    values = {each.key: each.value for each in status.values}
    assert (status.level, values["frames"], values["left out: broken"]) == (1, "1", "1")
    assert "cannot be used" in status.message


async def test_a_camera_that_repeats_an_image_with_new_stamps_gets_a_warning_and_no_pose() -> None:
    heard = Heard()
    async with running(heard) as bridge:
        await drive(bridge, heard, 2)
        for row in range(2, 5):
            send(bridge, frame_at(1, depth=True), row)
        heard.messages.clear()
        await heard.until(count_of(DIAGNOSTICS, 2))

    status = heard.of(DIAGNOSTICS, MAKER)[-1].status[0]
    assert status.level == 1
    assert "/camera/color/image_raw repeats an image with a new stamp" in status.message
    assert not heard.of(POSE_WITH_COVARIANCE, MAKER)


async def test_a_frame_without_texture_is_counted_as_lost_and_the_next_one_goes_on() -> None:
    heard = Heard()
    async with running(heard) as bridge:
        for row in range(5):
            frame = frame_at(row, depth=True)
            if row == 2:
                frame = replace(frame, rgb=np.full_like(frame.rgb, 128))
            send(bridge, frame, row)
        await heard.until(count_of(POSE_WITH_COVARIANCE, 4))

    assert (bridge.frames, bridge.lost_frames) == (5, 1)
    stamps = [each.header.stamp.nanosec for each in heard.of(POSE_WITH_COVARIANCE, MAKER)]
    assert stamps == [0, 100_000_000, 300_000_000, 400_000_000]


@pytest.mark.parametrize(
    ("content", "cause"), [(None, "No such file"), (b"", "it is empty"), (b"se\xffcret", "than ASCII")]
)
async def test_a_token_file_that_cannot_be_read_is_named_with_the_cause(
    tmp_path: Path, content: bytes | None, cause: str
) -> None:
    file = tmp_path / "robot.token"
    if content is not None:
        file.write_bytes(content)
    options = BridgeOptions(url="ws://127.0.0.1:1/ws", token_file=str(file))

    with pytest.raises(UsageError) as told:
        async with connected_bridge(options, lambda message: None, is_ros1=True):
            pass
    assert str(file) in told.value.message
    assert cause in told.value.message
    assert "cret" not in told.value.message


EXPIRED = Unauthorized("the token has expired", hint="issue a new one")


@pytest.mark.parametrize("failure", [None, EXPIRED], ids=["lost", "refused"])
async def test_diagnostics_and_one_line_say_why_there_is_no_connection_and_the_bridge_goes_on(
    failure: Unauthorized | None, capsys: pytest.CaptureFixture[str]
) -> None:
    heard, stats = Heard(), SimpleNamespace(last_error=EXPIRED.message)
    async with running(heard, SimpleNamespace(connected=False, failure=failure, stats=stats)):
        await heard.until(count_of(DIAGNOSTICS, 2))

    said = "no connection to the platform: the token has expired"
    assert {each.status[0].message for each in heard.of(DIAGNOSTICS, MAKER)} == {said}
    assert said in "".join(capsys.readouterr())


async def never_answered(query: PoseQuery) -> PoseAnswer:
    await asyncio.Event().wait()
    raise AssertionError


@pytest.mark.parametrize(
    ("connected", "reason", "text"),
    [
        (True, "too fast", " of 10 images were left out: they come faster"),
        (False, "no connection", "no connection to the"),
    ],
    ids=["slow", "outage"],
)
async def test_images_that_wait_for_a_late_pose_are_left_out_with_the_cause(
    connected: bool, reason: str, text: str
) -> None:
    heard = Heard()
    robot = SimpleNamespace(connected=connected, failure=None, stats=SimpleNamespace(last_error=""))
    async with running(
        heard, robot, make_mapper=lambda T: Mapper(ask=never_answered), queue_frames=2
    ) as bridge:
        send(bridge, frame_at(0, depth=True), 0)  # the first image needs no query
        await heard.until(count_of(POSE_WITH_COVARIANCE, 1))
        for row in range(1, 10):
            send(bridge, frame_at(row % 5, depth=True), row)
            await asyncio.sleep(0)
        heard.messages.clear()
        await heard.until(count_of(DIAGNOSTICS, 2))

    assert any(text in each.status[0].message for each in heard.of(DIAGNOSTICS))
    for message in heard.of(DIAGNOSTICS):
        status = message.status[0]
        left_out = {each.key for each in status.values if "left out" in each.key and each.value != "0"}
        assert left_out == {f"left out: {reason}"}
        assert status.level == (1 if connected else 2)


async def test_a_robot_that_is_lost_for_long_is_an_error() -> None:
    heard = Heard()
    async with running(heard, clock=lambda: 10 * time.monotonic()) as bridge:
        await drive(bridge, heard, 2)
        heard.messages.clear()
        await heard.until(
            lambda _: any(each.status[0].message.startswith("lost for ") for each in heard.of(DIAGNOSTICS))
        )

    status = heard.of(DIAGNOSTICS)[-1].status[0]
    assert (status.level, {each.key: each.value for each in status.values}["status"]) == (2, "lost")
