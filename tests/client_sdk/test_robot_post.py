"""`Robot.post` and `on_change`, which load generators use."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import pytest

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config import SessionSettings
from rse_pf.errors import Disconnected
from rse_pf.wire import Command, Failure, Result, make_codec
from rse_pf.wire.client_session import Answered
from rse_pf.wire.preencoded import preencode
from tests.kit.fakes import FakeRobot, FakeServer, answer_at_once, answer_nothing

FAST = SessionSettings(stall_timeout_s=0.4, ping_interval_s=0.2)


def connect(server: FakeServer, **options: Any) -> client_sdk.Robot:
    return client_sdk.connect(
        server.url,
        settings=FAST,
        timings=ConnectTimings(reconnect_max_s=0.05),
        random=random.Random(1),
        **options,
    )


class Ends:
    """Collect the answers that `Robot.post` delivers."""

    def __init__(self) -> None:
        self.heard: list[Answered] = []
        self._news = asyncio.Event()

    def __call__(self, event: Answered) -> None:
        self.heard.append(event)
        self._news.set()

    async def until(self, count: int) -> None:
        while len(self.heard) < count:
            self._news.clear()
            await self._news.wait()


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
async def test_a_preencoded_payload_is_answered_in_every_codec(codec: str) -> None:
    async with FakeServer().running() as server, connect(server, codec=codec) as robot:
        ends = Ends()
        robot.post("echo", preencode(make_codec(codec), {"value": [1, 2.5]}), ends)
        await ends.until(1)
        assert isinstance(ends.heard[0].answer, Result)
        assert ends.heard[0].answer.reply == {"value": [1, 2.5]}


async def test_a_posted_command_is_sent_again_on_the_next_socket_and_ends_once() -> None:
    async with FakeServer(answer=answer_nothing).running() as server, connect(server) as robot:
        ends = Ends()
        payload = preencode(make_codec("zlib"), {"value": 7})
        robot.post("echo", payload, ends)
        await server.until(lambda: len(server.all_commands) == 1)
        server.answer = answer_at_once
        server.cut()
        await ends.until(1)
        assert isinstance(ends.heard[0].answer, Result)
        assert ends.heard[0].answer.reply == {"value": 7}
        assert robot.stats.resent == 1
        assert robot.stats.duplicates == 0


async def test_an_unanswered_posted_command_expires() -> None:
    async with FakeServer(answer=answer_nothing).running() as server, connect(server) as robot:
        ends = Ends()
        robot.post("echo", {"value": 1}, ends, deadline_s=0.1)
        await ends.until(1)
        assert isinstance(ends.heard[0].answer, Failure)
        assert ends.heard[0].answer.code == "expired"


async def test_a_second_answer_to_one_command_is_dropped() -> None:
    async def twice(server: FakeServer, robot: FakeRobot, command: Command) -> None:
        answer = answer_at_once(server, robot, command)
        await robot.websocket.send(robot.session.codec.encode(answer))

    def answer(server: FakeServer, robot: FakeRobot, command: Command) -> Result | Failure | None:
        server.extra = asyncio.ensure_future(twice(server, robot, command))
        return answer_at_once(server, robot, command)

    async with FakeServer(answer=answer).running() as server, connect(server) as robot:
        ends = Ends()
        robot.post("echo", {"value": 1}, ends)
        await server.until(lambda: robot.stats.dropped_answers == 1)
        assert len(ends.heard) == 1


async def test_nothing_is_posted_by_a_robot_that_is_closed() -> None:
    async with FakeServer().running() as server:
        async with connect(server) as robot:
            pass
        with pytest.raises(Disconnected):
            robot.post("echo", {}, Ends())


async def test_a_lost_connection_and_its_return_are_reported_once_each() -> None:
    changes: list[tuple[str, str]] = []
    back = asyncio.Event()

    def changed(change: str, detail: str) -> None:
        changes.append((change, detail))
        if change == "link-back":
            back.set()

    async with FakeServer().running() as server, connect(server, on_change=changed):
        server.cut()
        await back.wait()
    assert changes == [("link-lost", "closed"), ("link-back", "fake")]


async def test_a_stalled_connection_is_reported_with_its_reason() -> None:
    changes: list[tuple[str, str]] = []
    lost = asyncio.Event()

    def changed(change: str, detail: str) -> None:
        changes.append((change, detail))
        lost.set()

    async with FakeServer().running() as server, connect(server, on_change=changed) as robot:
        server.deaf = True
        robot.post("echo", {"value": 1}, Ends())
        await lost.wait()
        server.deaf = False
    assert changes[0] == ("link-lost", "silence")
