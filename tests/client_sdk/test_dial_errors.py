"""A slow dial gets one more beside it, the first that is through wins, and nothing is left open."""

from __future__ import annotations

import asyncio
import random
from contextlib import suppress

import pytest
from fake_platform import FakePlatform

import client_sdk
from client_sdk.dial_errors import again_after_s, dial_beside
from rse_pf.config import SessionSettings
from rse_pf.errors import ConnectError

SOON_S = 10.0


class Network:
    """Dials that end when the test says so."""

    def __init__(self, most: int = 2) -> None:
        self.begun: list[asyncio.Future[str]] = []
        self.cancelled: list[int] = []
        self.dropped: list[str] = []
        self.pause: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._news = asyncio.Event()
        work = dial_beside(self.dial, self.dropped.append, self.new_pause, most=most)
        self.winner = asyncio.ensure_future(work)

    def new_pause(self) -> asyncio.Future[None]:
        self.pause = asyncio.get_running_loop().create_future()
        return self.pause

    async def dial(self) -> str:
        number = len(self.begun)
        self.begun.append(asyncio.get_running_loop().create_future())
        self._news.set()
        try:
            return await asyncio.shield(self.begun[number])
        except asyncio.CancelledError:
            self.cancelled.append(number)
            raise

    async def until(self, count: int) -> None:
        """Wait until so many dials have begun."""
        while len(self.begun) < count:
            self._news.clear()
            await self._news.wait()


def play(story, most=2):
    """Run an async story against a fresh network, within a deadline."""

    async def run():
        return await story(Network(most))

    return asyncio.run(asyncio.wait_for(run(), SOON_S))


def test_a_dial_that_is_through_in_time_stays_alone():
    async def story(network):
        await network.until(1)
        network.begun[0].set_result("first")
        assert await network.winner == "first"
        assert network.pause.cancelled()
        return len(network.begun), network.cancelled, network.dropped

    assert play(story) == (1, [], [])


def test_a_second_dial_overtakes_one_that_hangs_and_ends_it():
    async def story(network):
        await network.until(1)
        network.pause.set_result(None)
        await network.until(2)
        network.begun[1].set_result("second")
        return await network.winner, network.cancelled, network.dropped

    assert play(story) == ("second", [0], [])


def test_a_first_dial_that_wakes_up_ends_the_second():
    async def story(network):
        await network.until(1)
        network.pause.set_result(None)
        await network.until(2)
        network.begun[0].set_result("first")
        return await network.winner, network.cancelled, network.dropped

    assert play(story) == ("first", [1], [])


def test_of_two_that_are_through_in_the_same_moment_one_is_dropped():
    async def story(network):
        await network.until(1)
        network.pause.set_result(None)
        await network.until(2)
        for number, future in enumerate(network.begun):
            future.set_result(str(number))
        winner = await network.winner
        return {winner, *network.dropped}, len(network.dropped)

    assert play(story) == ({"0", "1"}, 1)


@pytest.mark.parametrize("refused", [0, 1])
def test_a_refusal_of_one_is_one_of_both(refused):
    async def story(network):
        await network.until(1)
        network.pause.set_result(None)
        await network.until(2)
        network.begun[refused].set_exception(ConnectError("full"))
        with pytest.raises(ConnectError):
            await network.winner
        return network.cancelled

    assert play(story) == [1 - refused]


def test_one_that_timed_out_says_nothing_of_the_other():
    async def story(network):
        await network.until(1)
        network.pause.set_result(None)
        await network.until(2)
        network.begun[0].set_exception(TimeoutError())
        network.begun[1].set_result("second")
        return await network.winner, network.cancelled

    assert play(story) == ("second", [])


def test_one_that_timed_out_gets_a_successor_until_there_were_enough():
    async def story(network):
        for number in range(5):
            await network.until(number + 1)
            if number:
                network.begun[number - 1].set_exception(TimeoutError())
            network.pause.set_result(None)
        network.begun[4].set_exception(TimeoutError())
        with pytest.raises(TimeoutError):
            await network.winner
        return len(network.begun), network.cancelled

    assert play(story, most=5) == (5, [])


def test_never_are_more_than_two_open():
    async def story(network):
        await network.until(1)
        network.pause.set_result(None)
        await network.until(2)
        network.pause.set_result(None)
        for _ in range(10):  # turns of the loop, in which a third could begin
            await asyncio.sleep(0)
        assert len(network.begun) == 2
        network.begun[0].set_exception(TimeoutError())
        await network.until(3)
        assert not network.winner.done()
        network.begun[2].set_result("third")
        return await network.winner, network.cancelled, len(network.begun)

    assert play(story, most=8) == ("third", [1], 3)


def test_one_that_is_through_counts_more_than_one_that_fails_with_it():
    async def story(network):
        await network.until(1)
        network.pause.set_result(None)
        await network.until(2)
        network.begun[0].set_exception(ConnectError("late"))
        network.begun[1].set_result("second")
        return await network.winner, network.dropped

    assert play(story) == ("second", [])


@pytest.mark.parametrize("dials", [1, 2])
def test_who_gives_up_leaves_nothing_open(dials):
    async def story(network):
        await network.until(1)
        if dials == 2:
            network.pause.set_result(None)
            await network.until(2)
        network.winner.cancel()
        with suppress(asyncio.CancelledError):
            await network.winner
        return sorted(network.cancelled), network.pause.done()

    assert play(story) == (list(range(dials)), True)


def test_robots_do_not_dial_again_in_step():
    times = [again_after_s(0.5, random.Random(seed)) for seed in range(200)]

    assert 0.4 <= min(times) < 0.42
    assert 0.58 < max(times) <= 0.6
    assert again_after_s(0.0, random.Random(1)) == 0.0


class DeafDoor:
    """In front of a platform: takes what is dialled, says nothing to the first ones, relays the others."""

    def __init__(self, platform: FakePlatform, deaf: int) -> None:
        self.dialled = 0
        self.ended = 0
        self._deaf = deaf
        self._platform = platform
        self._server: asyncio.Server | None = None

    async def __aenter__(self) -> DeafDoor:
        self._server = await asyncio.start_server(self._take, "127.0.0.1", 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._server is not None
        self._server.close()

    @property
    def url(self) -> str:
        assert self._server is not None
        return f"ws://127.0.0.1:{self._server.sockets[0].getsockname()[1]}/ws"

    async def _take(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.dialled += 1
        if self.dialled <= self._deaf:
            with suppress(ConnectionError):
                while await reader.read(4096):
                    pass
            self.ended += 1
        else:
            far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._platform.port)
            await asyncio.gather(_relay(reader, far_writer), _relay(far_reader, writer))
            far_writer.close()
        writer.close()


async def _relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(ConnectionError):
        while data := await reader.read(65536):
            writer.write(data)
    writer.close()


@pytest.mark.system
def test_a_robot_is_in_long_before_a_dial_that_hangs_is_over_and_says_hello_once():
    async def test():
        settings = SessionSettings(connect_timeout_s=60.0, dial_again_s=0.05)
        async with (
            FakePlatform() as platform,
            DeafDoor(platform, deaf=1) as door,
            client_sdk.connect(door.url, settings=settings, random=random.Random(1)) as robot,
        ):
            answer = await robot.call("echo", {"value": 7})
            assert answer.reply == {"value": 7}
            assert len(platform.sockets) == 1
            assert door.dialled == 2

    asyncio.run(asyncio.wait_for(test(), SOON_S))
