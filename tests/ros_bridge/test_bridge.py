"""Tests of `ros_bridge.bridge` with a robot that answers by itself: no ROS, no platform."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from client_sdk.bags.message_maker import MessageMaker
from client_sdk.bags.message_types import CAMERA_INFO, DIAGNOSTICS, IMAGE, POSE_WITH_COVARIANCE
from client_sdk.frontend import Frame
from client_sdk.mapper import Mapper
from ros_bridge import Bridge, BridgeOptions
from ros_bridge.bridge import connected_bridge
from ros_bridge.outgoing import Message
from rse_pf.errors import Unauthorized, UsageError
from tests.kit.fake_live_map import solve
from tests.kit.flat_world import frame_at
from tests.kit.small_bags import raw_image

START_NS = 1_700_000_000_000_000_000
MAKER = MessageMaker(is_ros1=True)


class Heard:
    """What a bridge published; `until` waits for it."""

    def __init__(self) -> None:
        self.messages: list[Message] = []
        self._changed = asyncio.Event()

    def publish(self, message: Message) -> None:
        self.messages.append(message)
        self._changed.set()

    async def until(self, enough: Callable[[list[Message]], bool]) -> None:
        while not enough(self.messages):
            self._changed.clear()
            await asyncio.wait_for(self._changed.wait(), 20)

    def of(self, kind: str, maker: MessageMaker) -> list[Any]:
        return [maker.decode(kind, each.data) for each in self.messages if each.kind == kind]


def messages_of(maker: MessageMaker, frame: Frame, row: int) -> list[tuple[str, bytes]]:
    """Return the messages that a driver would send for a frame."""
    stamp, camera = START_NS + row * 100_000_000, frame.camera
    roi = maker.make(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    info = maker.make(
        CAMERA_INFO, header=maker.header(stamp, "eye"), height=camera.height, width=camera.width,
        distortion_model="plumb_bob", d=np.zeros(5), k=camera.matrix.ravel(), r=np.eye(3).ravel(),
        p=np.hstack((camera.matrix, np.zeros((3, 1)))).ravel(), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip
    colour = raw_image(maker, stamp, frame.rgb, "rgb8")
    depth = raw_image(maker, stamp, np.round(1000 * frame.depth_m).astype(np.uint16), "16UC1")
    return [
        ("info", maker.encode(CAMERA_INFO, info)),
        ("colour", maker.encode(IMAGE, colour)),
        ("depth", maker.encode(IMAGE, depth)),
    ]


@asynccontextmanager
async def running(heard: Heard, robot: Any = None, **options: Any) -> AsyncIterator[Bridge]:
    """A bridge that runs, and publishes to *heard*."""
    bridge = Bridge(
        Mapper(ask=solve), BridgeOptions.of(options), heard.publish, is_ros1=True, robot=robot
    )  # fmt: skip
    task = asyncio.create_task(bridge.run())
    try:
        yield bridge
        assert not task.done()
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def send(bridge: Bridge, frame: Frame, row: int, *roles: str) -> None:
    """Send the messages of a frame, or those of some roles."""
    for role, data in messages_of(MAKER, frame, row):
        if role in (roles or ("info", "colour", "depth")):
            bridge.receive(role, data)  # type: ignore[arg-type]


def count_of(kind: str, count: int) -> Callable[[list[Message]], bool]:
    """Return whether there are so many messages of a kind."""
    return lambda heard: sum(each.kind == kind for each in heard) >= count


async def drive(bridge: Bridge, heard: Heard, rows: int) -> None:
    """Send frames of the flat world, and wait for the pose of each one."""
    for row in range(rows):
        send(bridge, frame_at(row, depth=True), row)
        await heard.until(count_of(POSE_WITH_COVARIANCE, row + 1))


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
