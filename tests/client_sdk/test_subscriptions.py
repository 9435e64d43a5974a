"""Updates of subscribed topics: the newest value of each key, across reconnects and moves."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import pytest

import client_sdk
from client_sdk.commands.subscriptions import Updates
from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config import SessionSettings
from rse_pf.errors import Forbidden
from rse_pf.wire import CODECS
from tests.kit.fake_platform import FakePlatform

QUICK = SessionSettings(
    stall_timeout_s=0.3, ping_interval_s=0.1, ping_timeout_s=0.5,
)  # fmt: skip
TIMINGS = ConnectTimings(connect_timeout_s=0.5, reconnect_max_s=0.05)


def robot(platform: FakePlatform, **options: Any) -> client_sdk.Robot:
    return client_sdk.connect(
        platform.url, settings=QUICK, timings=TIMINGS, random=random.Random(1), **options
    )


async def subscribed(platform: FakePlatform, number: int = 0) -> Any:
    """Wait until the connection *number* of the fake server has a subscription, and return it."""
    await platform.until(lambda: len(platform.sockets) > number and bool(platform.sockets[number].topics))
    return platform.sockets[number]


@pytest.mark.parametrize("codec", CODECS)
async def test_a_robot_gets_the_values_of_a_topic_until_it_leaves_the_loop(codec: str) -> None:
    async with FakePlatform() as platform, robot(platform, codec=codec) as a_robot:
        updates = a_robot.subscribe("live/m")
        socket = await subscribed(platform)
        assert list(socket.topics.values()) == ["live/m"]
        await socket.update("map", {"keyframes": 1})
        await socket.update("pose/a", 7)

        seen = []
        async for key, value in updates:
            seen.append((key, value))
            if len(seen) == 2:
                break

        assert seen == [("map", {"keyframes": 1}), ("pose/a", 7)]
        await platform.until(lambda: not socket.topics)


async def test_a_robot_that_reads_late_gets_the_newest_value_of_each_key() -> None:
    async with FakePlatform() as platform, robot(platform) as a_robot:
        async with a_robot.subscribe("live/m") as updates:
            socket = await subscribed(platform)
            for step in range(50):
                await socket.update("pose/a", step)
                await socket.update("pose/b", -step)
            assert (await a_robot.call("echo", {"value": 1})).reply == {"value": 1}

            assert [await updates.next(), await updates.next()] == [("pose/a", 49), ("pose/b", -49)]
            assert updates.replaced == 98
        await platform.until(lambda: not socket.topics)
        with pytest.raises(StopAsyncIteration):
            await updates.next()


async def test_a_subscription_survives_a_lost_connection_and_a_move() -> None:
    async with FakePlatform() as platform, robot(platform) as a_robot:
        updates = a_robot.subscribe("live/m")
        first = await subscribed(platform)
        await first.update("map", 1)
        assert await updates.next() == ("map", 1)

        first.cut()
        second = await subscribed(platform, 1)
        await second.update("map", 2)
        assert await updates.next() == ("map", 2)

        platform.landing = "server-b"
        await second.move()
        third = await subscribed(platform, 2)
        await second.update("map", "old")
        await third.update("map", 3)
        assert await updates.next() == ("map", 3)
        assert (a_robot.stats.moves, a_robot.stats.reconnects) == (1, 1)


async def test_a_refused_topic_is_a_typed_error_and_affects_nothing_else() -> None:
    async with FakePlatform() as platform, robot(platform) as a_robot:
        refused, granted = a_robot.subscribe("live/secret"), a_robot.subscribe("live/m")
        socket = await subscribed(platform)
        await platform.until(lambda: len(socket.topics) == 2)
        identity = min(socket.topics)
        del socket.topics[identity]
        await socket.send(
            socket.session.refuse_updates(identity, Forbidden("not yours", hint="ask the operator")).data
        )
        await socket.update("map", 1)

        with pytest.raises(Forbidden, match="not yours"):
            await refused.next()
        assert await granted.next() == ("map", 1)
        refused.close()


async def test_values_that_nobody_reads_are_bounded() -> None:
    updates = Updates("live/m", lambda: None)

    for number in range(5000):
        updates.put(f"pose/{number}", number)

    assert await updates.next() == ("pose/904", 904)


async def test_a_blocking_robot_iterates_without_asyncio() -> None:
    async with FakePlatform() as platform:
        seen: list[Any] = []

        def drive() -> None:
            blocking = client_sdk.connect_blocking(platform.url, settings=QUICK, timings=TIMINGS)
            with blocking as a_robot, a_robot.subscribe("live/m") as updates:
                for key, value in updates:
                    seen.append((key, value))
                    break

        driving = asyncio.ensure_future(asyncio.to_thread(drive))
        socket = await subscribed(platform)
        await socket.update("map", 1)
        await driving
        assert seen == [("map", 1)]
