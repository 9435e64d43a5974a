"""A crowded server hands robots over: asked in turn, moved before they are cut, nothing lost."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json

import pytest

from client_sdk import connect
from rse_pf.config.elasticity import MOVE_WITHIN_MS
from rse_pf.wire import Move

pytestmark = pytest.mark.system

DEADLINE_S = 15.0


class HandshakePolicy:
    """A load balancer of bytes: each new connection goes to the server that *choose* names."""

    def __init__(self, choose) -> None:
        self._choose = choose
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> str:
        self._server = await asyncio.start_server(self._join, "127.0.0.1", 0)
        return f"ws://127.0.0.1:{self._server.sockets[0].getsockname()[1]}/ws"

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _join(self, reader, writer) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        there = None
        try:
            back, there = await asyncio.open_connection("127.0.0.1", self._choose().port)
            await asyncio.gather(self._copy(reader, there), self._copy(back, writer))
        except (OSError, asyncio.CancelledError):
            pass
        finally:
            for end in (writer, there):
                if end is not None:
                    end.close()

    async def _copy(self, reader, writer) -> None:
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
        with contextlib.suppress(OSError):
            writer.write_eof()


def move(server, query: str) -> tuple[int, dict]:
    status, _, body = server.http(f"/move?{query}", method="POST")
    return status, json.loads(body)


async def test_robots_move_under_load_and_every_command_is_answered_once(start_server):
    old, new = start_server(), start_server()
    target = [old]

    async def spread():
        while [(await asyncio.to_thread(each.status))["robots"] for each in (old, new)] != [2, 4]:
            pass

    async with HandshakePolicy(lambda: target[0]) as url, contextlib.AsyncExitStack() as stack:
        robots = [await stack.enter_async_context(connect(url)) for _ in range(6)]
        answers, enough = [], asyncio.Event()

        async def load(robot):
            for number in itertools.count():
                reply = await robot.call("echo", {"value": number}, deadline_s=5.0)
                answers.append(reply.reply["value"] == number)
                if enough.is_set():
                    return

        loads = [asyncio.create_task(load(robot)) for robot in robots]
        target[0] = new
        told = await asyncio.to_thread(move, old, "robots=4&spread_s=0.3")
        again = await asyncio.to_thread(move, old, "robots=4")
        await asyncio.wait_for(spread(), DEADLINE_S)
        enough.set()
        await asyncio.gather(*loads)
        stats = [robot.stats for robot in robots]
        left, taken = old.status(), new.status()

    assert told[0] == 202
    assert told[1]["robots"] == 4
    assert again[1]["robots"] == 0
    assert again[1]["under_way"]
    assert all(answers)
    assert sum(each.moves for each in stats) == 4
    assert sum(each.reconnects for each in stats) == 0
    assert (left["robots"], left["moved"], taken["robots"]) == (2, 4, 4)


async def test_the_request_to_move_gives_the_reason_and_the_time(start_server):
    server = start_server()

    async with server.robot() as robot:
        await asyncio.to_thread(move, server, "robots=1")
        asked = await robot.receive()

    assert isinstance(asked, Move)
    assert asked.reason == "rebalance"
    assert asked.within_ms == MOVE_WITHIN_MS


@pytest.mark.parametrize(
    "query", ["", "robots=x", "robots=-1", "robots=1&spread_s=nan", "robots=1&spread_s=-1", "robots=1e9"]
)
def test_a_bad_migration_request_is_refused(start_server, query):
    server = start_server()

    assert move(server, query)[0] == 400
    assert server.status()["moved"] == 0


async def test_the_status_shows_bytes_and_the_longest_wait(start_server):
    server = start_server()

    async with server.robot() as robot:
        for number in range(3):
            await robot.ask(number, "work", {"rest_s": 0.0, "fill": 1000})
    status = server.status()

    assert status["bytes_out"] > 3000
    assert 0 < status["bytes_in"] < status["bytes_out"]
    assert 0 <= status["queue_ms"] < 5000
