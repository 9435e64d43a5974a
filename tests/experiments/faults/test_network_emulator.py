"""The link in user space: what arrives when, in what order, and what a cut does."""

from __future__ import annotations

import asyncio
import contextlib
import random
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.extensions.experiments.faults.network_emulator import (
    PROFILES,
    EmulatedLink,
    Lane,
    LinkProfile,
    retransmitted_s,
)

SOON_S = 10.0


def lane(**options: Any) -> Lane:
    return Lane(
        **{"delay_s": 0.05, "jitter_s": 0.0, "mbit_per_s": None, "random": random.Random(1), **options}
    )


class Echo:
    """A server that sends back what it hears; ``ended`` counts the connections that it saw end."""

    def __init__(self) -> None:
        self.port = 0
        self.accepted = 0
        self.ended = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.accepted += 1
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(65536):
                writer.write(data)
        self.ended.set()
        writer.close()


@contextlib.asynccontextmanager
async def echo() -> AsyncIterator[Echo]:
    server = Echo()
    listening = await asyncio.start_server(server.serve, "127.0.0.1", 0)
    server.port = listening.sockets[0].getsockname()[1]
    try:
        yield server
    finally:
        listening.close()


async def trip_s(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, data: bytes) -> float:
    began = time.monotonic()
    writer.write(data)
    assert await asyncio.wait_for(reader.readexactly(len(data)), SOON_S) == data
    return time.monotonic() - began


# --- when bytes arrive --------------------------------------------------------------------------------


def test_bytes_arrive_after_the_delay() -> None:
    assert lane().arrival_s(10.0, 1000) == pytest.approx(10.05)


@given(st.lists(st.floats(0, 0.02), max_size=50), st.integers(0, 1000))
def test_jitter_changes_no_order_and_stays_within_its_width(pauses_s: list[float], seed: int) -> None:
    shaky = lane(jitter_s=0.02, random=random.Random(seed))
    now, last = 5.0, 0.0
    for pause_s in pauses_s:
        now += pause_s
        arrival = shaky.arrival_s(now, 100)
        assert arrival >= last
        assert 0.03 - 1e-9 <= arrival - now <= 0.07 + 1e-9
        last = arrival


def test_equal_seeds_give_equal_links() -> None:
    def arrivals(seed: int) -> list[float]:
        shaky = lane(jitter_s=0.02, random=random.Random(seed))
        return [shaky.arrival_s(float(now), 10) for now in range(20)]

    assert arrivals(1) == arrivals(1)
    assert arrivals(1) != arrivals(2)


@pytest.mark.parametrize(
    ("sent_s", "healed_s", "again_s"), [(0.0, 0.1, 0.2), (0.0, 0.3, 0.6), (0.0, 2.0, 3.0), (5.0, 5.0, 5.0)]
)
def test_what_fell_into_a_cut_is_sent_again_as_tcp_does(
    sent_s: float, healed_s: float, again_s: float
) -> None:
    assert retransmitted_s(sent_s, healed_s) == pytest.approx(again_s)


# --- real sockets -------------------------------------------------------------------------------------


async def test_megabytes_arrive_whole_and_in_order_through_a_bad_link() -> None:
    profile = LinkProfile(name="t", up_s=0.01, down_s=0.01, jitter_s=0.02, up_mbit_per_s=200.0)
    async with echo() as server, EmulatedLink(profile, "127.0.0.1", server.port, seed=4) as link:
        reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
        data = random.Random(1).randbytes(3_000_000)
        assert await trip_s(reader, writer, data) >= 3_000_000 * 8 / 200e6
        writer.close()


async def test_a_cut_is_silent_and_nothing_is_lost_when_it_heals() -> None:
    async with echo() as server, EmulatedLink(PROFILES["none"], "127.0.0.1", server.port) as link:
        reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
        await trip_s(reader, writer, b"before")
        link.cut()
        writer.write(b"during")
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(reader.read(1), 0.3)
        assert not reader.at_eof()
        assert not server.ended.is_set()
        link.heal()
        writer.write(b" after")
        assert await asyncio.wait_for(reader.readexactly(12), SOON_S) == b"during after"
        writer.close()


async def test_the_server_does_not_learn_during_a_cut_that_the_robot_left() -> None:
    async with echo() as server, EmulatedLink(PROFILES["none"], "127.0.0.1", server.port) as link:
        reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
        await trip_s(reader, writer, b"before")
        link.cut()
        writer.close()
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(server.ended.wait(), 0.3)
        link.heal()
        await asyncio.wait_for(server.ended.wait(), SOON_S)
