"""A robot records what it says and hears, with pictures of its frames only if it allows them."""

from __future__ import annotations

import asyncio
import base64
import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image

import client_sdk
from client_sdk.frontend import Frame
from rse_pf.config import PnpSettings, SessionSettings
from rse_pf.extensions.recording.reader import open_recording
from rse_pf.extensions.recording.robot_recorder import RobotRecorder
from rse_pf.geometry import Camera
from rse_pf.pnp.problems import make_problem
from rse_pf.services import pnp
from tests.kit.fakes import FakeServer

TOKEN = "eyJhbGciOiJFZERTQSJ9." + base64.urlsafe_b64encode(b'{"tenant":"acme"}').decode() + ".c2lnbmVkYnl1cw"
PROBLEM = make_problem(seed=3)
CAMERA = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)
FRAME = Frame(
    timestamp_s=12.5, rgb=np.full((480, 640, 3), 90, np.uint8), depth_m=np.zeros((480, 640), np.float32),
    camera=CAMERA,
)  # fmt: skip


def drive(folder: Path, codec: str = "bin", **options: Any) -> None:
    """Let a robot called "r" record a few poses."""

    async def work() -> None:
        server = FakeServer()
        pnp.register(server.registry, PnpSettings())
        async with (
            server.running(),
            client_sdk.connect(server.url, token=TOKEN, codec=codec, record=folder, **options) as robot,
        ):
            for _ in range(3):
                robot.record_frame(FRAME, np.eye(4))
                await robot.solve_pnp(PROBLEM.points_world, PROBLEM.pixels, PROBLEM.camera)
            await robot.call("echo", {"value": "left out"})

    asyncio.run(work())


def topics(folder: Path) -> dict[str, list[bytes]]:
    """Return the messages of the one file in *folder*, by the first word of their topic."""
    found: dict[str, list[bytes]] = {}
    (file,) = folder.iterdir()
    with file.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            found.setdefault(channel.topic.split("/")[1], []).append(message.data)
    return found


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
def test_a_robot_that_records_has_its_commands_and_answers_in_a_file(tmp_path: Path, codec: str):
    drive(tmp_path / "made" / "here", codec)

    commands = list(open_recording(tmp_path / "made" / "here").commands())

    assert [each.reply.reply["verdict"] for each in commands if each.reply] == ["ok"] * 3
    assert {each.robot[:6] for each in commands} == {"robot-"}
    found = topics(tmp_path / "made" / "here")
    assert len(found["poses"]) == len(found["odometry"]) == 3
    assert json.loads(found["odometry"][0])["T_odom_camera"] == np.eye(4).ravel().tolist()
    assert "frames" not in found


def test_pictures_are_small_and_only_there_if_the_robot_allows_them(tmp_path: Path):
    drive(tmp_path, thumbnails=True)

    pictures = [json.loads(each) for each in topics(tmp_path)["frames"]]

    assert [each["format"] for each in pictures] == ["jpeg"] * 3
    with Image.open(BytesIO(base64.b64decode(pictures[0]["data"]))) as picture:
        assert picture.size == (160, 120)
        assert abs(np.asarray(picture).astype(int) - 90).max() <= 3


def test_a_map_that_the_robot_saves_is_a_point_cloud_in_the_file(tmp_path: Path):
    recorder = RobotRecorder(tmp_path, thumbnails=False, session=SessionSettings())
    recorder.start()

    recorder.record_map(np.arange(600_000, dtype=np.float32).reshape(-1, 3))
    asyncio.run(recorder.stop())

    (cloud,) = (json.loads(each) for each in topics(tmp_path)["map"])
    found = np.frombuffer(base64.b64decode(cloud["data"]), "<f4").reshape(-1, 3)
    assert found[:2].tolist() == [[0, 1, 2], [9, 10, 11]]
    assert len(found) <= 100_000
    assert [each["name"] for each in cloud["fields"]] == ["x", "y", "z"]


def test_neither_token_nor_tenant_nor_name_is_in_the_file(tmp_path: Path):
    drive(tmp_path, "json")

    (file,) = tmp_path.iterdir()
    assert not [word for word in (TOKEN, "acme", '"robot":"r"') if word.encode() in file.read_bytes()]


def test_what_does_not_fit_into_the_queue_is_dropped_and_counted(tmp_path: Path):
    recorder = RobotRecorder(tmp_path, thumbnails=False, session=SessionSettings())
    recorder.start()
    recorder._queue.maxsize = 1  # as on a robot whose disk is too slow

    for _ in range(5000):
        recorder.observe_message(1, "up", b"")
    recorder._queue.maxsize = 10
    asyncio.run(recorder.stop())

    assert recorder.dropped > 0
