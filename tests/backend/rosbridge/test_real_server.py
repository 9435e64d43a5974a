"""Rosbridge clients of a real server with two workers: tokens, topics between workers, and dead clients."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from guarded_server import GuardedServer
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus

pytestmark = pytest.mark.slow
CLIENTS = 6
"""So many that both workers have some: each gets the next one."""


def enter(server: GuardedServer, token: str = "", **more: Any) -> connect:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    url = f"ws://127.0.0.1:{server.port}/rosbridge"
    return connect(url, additional_headers=headers, compression=None, **more)


async def say(socket: ClientConnection, **operation: Any) -> None:
    await socket.send(json.dumps(operation))


async def hear(socket: ClientConnection) -> Any:
    return json.loads(await asyncio.wait_for(socket.recv(), 10))


async def until_seen(socket: ClientConnection, topic: str) -> None:
    """Ask for the topics until *topic* is one of them."""
    while True:
        await say(socket, op="call_service", id="t", service="/rosapi/topics")
        if topic in (await hear(socket))["values"]["topics"]:
            return


@pytest.fixture
def server(tmp_path: Path):
    with GuardedServer(tmp_path, serving={"rosbridge": True}, session={"max_commands_per_s": 0.0}) as started:
        yield started


async def test_a_message_reaches_the_clients_of_both_workers(server: GuardedServer) -> None:
    sockets = [await enter(server, server.token(f"r-{k}")) for k in range(CLIENTS)]
    talker, *listeners = sockets
    for each in listeners:
        await say(each, op="subscribe", topic="/chat", id="s")
        await say(each, op="call_service", id="e", service="/echo", args={"value": 1})
        assert (await hear(each))["result"]
    await until_seen(talker, "/chat")
    await say(talker, op="publish", topic="/chat", msg={"data": "x"})

    assert [(await hear(each))["msg"] for each in listeners] == [{"data": "x"}] * len(listeners)
    for each in sockets:
        await each.close()


async def test_a_client_shows_its_token_in_time_or_goes(server: GuardedServer) -> None:
    with pytest.raises(InvalidStatus) as refused:
        await enter(server, "nonsense")
    assert refused.value.response.status_code == 401
    late = await enter(server)
    wrong, right = await enter(server), await enter(server)
    await say(wrong, op="auth", mac="nonsense")
    assert (await hear(wrong))["code"] == "unauthorized"
    await say(right, op="auth", mac=server.token("r"))
    await say(right, op="call_service", id=1, service="echo", args={"value": 2})
    assert (await hear(right))["values"] == {"value": 2}
    await asyncio.wait_for(asyncio.gather(late.wait_closed(), wrong.wait_closed()), 10)

    assert (late.close_code, wrong.close_code) == (4401, 4401)
    await right.close()


async def test_a_subscriber_that_is_silent_stays_and_one_that_is_dead_goes(server: GuardedServer) -> None:
    alive = await enter(server, server.token("a"), ping_interval=None)
    dead = await enter(server, server.token("d"), ping_interval=None)
    dead.transport.pause_reading()  # so that it answers no ping
    await until_seen_closed(server, alive)
    dead.transport.resume_reading()
    await asyncio.wait_for(dead.wait_closed(), 10)

    assert dead.close_code == 1001
    await say(alive, op="call_service", id=1, service="echo", args={"value": 2})
    assert (await hear(alive))["result"]
    await alive.close()


async def until_seen_closed(server: GuardedServer, alive: ClientConnection) -> None:
    """Wait, for less than 20 s, until the server would have closed who is silent."""
    with pytest.raises(asyncio.TimeoutError):
        await asyncio.wait_for(alive.recv(), 7)
