"""A program gives a robot a recorder of its own: ``connect(record=OBJECT)``."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

import client_sdk
from client_sdk import recording
from client_sdk.frontend import Frame
from rse_pf.errors import UsageError
from rse_pf.geometry import Camera
from rse_pf.wire import Command, Hello, Result, Welcome
from tests.kit.fakes import FakeServer
from tests.kit.quick_robots import robot
from tests.kit.server_thread import server_thread

CAMERA = Camera(fx=50.0, fy=50.0, cx=32.0, cy=24.0, width=64, height=48)
FRAME = Frame(
    timestamp_s=12.5,
    rgb=np.zeros((48, 64, 3), np.uint8),
    depth_m=np.zeros((48, 64), np.float32),
    camera=CAMERA,
)


class Tap(client_sdk.RobotRecorder):
    """Keep what a robot sends and receives; the other methods are inherited."""

    def __init__(self):
        self.messages = []
        self.open = {}
        self.codec = None

    def open_connection(self, codec, token):
        self.codec = codec
        self.open[len(self.open) + 1] = token
        return len(self.open)

    def observe_message(self, connection, direction, data):
        assert connection in self.open
        decode = self.codec.decode_from_robot if direction == "up" else self.codec.decode_from_server
        self.messages.append((direction, type(decode(data))))

    def close_connection(self, connection):
        self.messages.append(("closed", connection))


class FailingTap(client_sdk.RobotRecorder):
    """Raise in every method, and count the calls of each one."""

    def __init__(self):
        self.calls = []

    def __getattribute__(self, name):
        if name == "calls" or name.startswith("_"):
            return object.__getattribute__(self, name)

        def fail(*_):
            self.calls.append(name)
            raise KeyError("a bug of the program")

        return fail


async def test_a_tap_sees_every_message_of_every_connection_in_its_order():
    tap = Tap()
    async with FakeServer().running() as server, robot(server.url, token="t1", record=tap) as a_robot:
        await a_robot.call("echo", {"value": 1})
        server.cut()
        await a_robot.call("echo", {"value": 2}, deadline_s=20)
        a_robot.record_frame(FRAME)

    one = [("up", Hello), ("down", Welcome), ("up", Command), ("down", Result)]
    # A second command may be sent on the first connection before the robot notices that it was cut.
    first_end = tap.messages.index(("closed", 1))
    for messages in (tap.messages[:first_end], tap.messages[first_end:]):
        assert [each for each in messages if each in one][:4] == one
    assert tap.messages[-1] == ("closed", 2)
    assert tap.open == {1: "t1", 2: "t1"}
    assert a_robot.stats.callback_errors == 0


async def test_a_tap_that_raises_is_reported_once_and_costs_nothing_but_the_report(caplog):
    tap = FailingTap()
    async with FakeServer().running() as server, robot(server.url, record=tap) as a_robot:
        for value in range(3):
            assert (await a_robot.call("echo", {"value": value})).reply == {"value": value}
        a_robot.record_frame(FRAME)

    assert set(tap.calls) == {
        "start", "open_connection", "observe_message", "record_frame", "close_connection", "stop",
    }  # fmt: skip
    assert a_robot.stats.callback_errors == len(tap.calls)
    assert a_robot.stats.reconnects == 0
    assert sorted(line.split()[0] for line in caplog.messages if "the robot goes on" in line) == sorted(
        f"record.{name}" for name in set(tap.calls)
    )


def test_a_tap_that_raises_does_not_stop_a_blocking_robot(caplog):
    with (
        server_thread() as served,
        client_sdk.connect_blocking(served.url, record=FailingTap()) as a_robot,
    ):
        assert a_robot.call("echo", {"value": 3}).reply == {"value": 3}
        assert a_robot.stats.callback_errors > 0
    assert caplog.text.count("record.observe_message raised KeyError") == 1


async def test_a_recorder_that_does_not_stop_is_left_after_its_time(monkeypatch, caplog):
    class Endless(client_sdk.RobotRecorder):
        async def stop(self):
            await asyncio.Event().wait()

    monkeypatch.setattr(recording, "STOP_TIMEOUT_S", 0.05)
    async with FakeServer().running() as server, robot(server.url, record=Endless()):
        pass

    assert "record.stop raised TimeoutError" in caplog.text


def test_what_is_neither_a_folder_nor_a_recorder_is_refused():
    with pytest.raises(UsageError, match="record= is a int") as caught:
        client_sdk.connect("ws://127.0.0.1:1/ws", record=3)
    assert "client_sdk.RobotRecorder" in caught.value.hint
