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

from rse_pf.errors import UsageError
from rse_pf.local.faults.network_emulator import (
    PROFILES,
    EmulatedLink,
    Lane,
    LinkProcess,
    LinkProfile,
    profile_named,
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


def test_a_rate_makes_bytes_wait_for_those_before_them() -> None:
    slow = lane(mbit_per_s=8.0)
    assert [slow.arrival_s(10.0, 1000) for _ in range(3)] == pytest.approx([10.051, 10.052, 10.053])
    assert slow.arrival_s(11.0, 1000) == pytest.approx(11.051)


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


def test_jitter_that_is_wider_than_the_delay_never_arrives_before_it_was_sent() -> None:
    shaky = lane(delay_s=0.015, jitter_s=0.025)
    assert all(shaky.arrival_s(now, 100) > now for now in range(1, 500))


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


def test_the_papers_link_is_its_round_trip_less_its_computing() -> None:
    assert PROFILES["paper"].round_trip_s == pytest.approx(0.13)
    with pytest.raises(UsageError, match="no link named 'moon'"):
        profile_named("moon")


# --- real sockets -------------------------------------------------------------------------------------


async def test_a_relayed_byte_takes_the_nominal_time() -> None:
    async with echo() as server:
        profile = LinkProfile(name="t", up_s=0.04, down_s=0.03)
        async with EmulatedLink(profile, "127.0.0.1", server.port) as link:
            reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
            await trip_s(reader, writer, b"first")
            trips = [await trip_s(reader, writer, b"x" * 3000) for _ in range(9)]
            assert min(trips) >= 0.07 - 0.002
            assert sorted(trips)[4] <= 0.07 + 0.02
            writer.close()


async def test_the_first_byte_waits_for_the_handshake() -> None:
    async with echo() as server, EmulatedLink(PROFILES["paper"], "127.0.0.1", server.port) as link:
        reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
        assert await trip_s(reader, writer, b"hello") >= 2 * 0.13 - 0.005
        writer.close()


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


async def test_who_dials_during_a_cut_is_connected_after_it() -> None:
    async with echo() as server, EmulatedLink(PROFILES["none"], "127.0.0.1", server.port) as link:
        link.cut()
        dialling = asyncio.ensure_future(asyncio.open_connection("127.0.0.1", link.port))
        done, _ = await asyncio.wait({dialling}, timeout=0.2)
        assert not done  # nobody answers
        assert server.accepted == 0
        link.heal()
        reader, writer = await dialling  # Linux asks again after a second
        await trip_s(reader, writer, b"hello")
        assert server.accepted == 1
        writer.close()


async def test_two_causes_of_a_cut_must_both_heal() -> None:
    async with echo() as server, EmulatedLink(PROFILES["none"], "127.0.0.1", server.port) as link:
        link.cut("a")
        link.cut("b")
        link.heal("a")
        assert link.is_cut
        link.heal("b")
        assert not link.is_cut
        assert link.cuts == 1


async def test_a_robot_is_dropped_when_nobody_listens_behind_the_link() -> None:
    async with echo() as server:
        port = server.port
    async with EmulatedLink(PROFILES["none"], "127.0.0.1", port) as link:
        reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
        assert await asyncio.wait_for(reader.read(), SOON_S) == b""
        writer.close()


async def test_a_profile_cuts_by_itself_now_and_then() -> None:
    # Short cuts: were half of the time cut, every 64th message would need six tries, which are 12.6 s.
    profile = LinkProfile(name="t", up_s=0.0, down_s=0.0, cut_every_s=0.05, cut_for_s=0.005)
    async with echo() as server, EmulatedLink(profile, "127.0.0.1", server.port, seed=2) as link:
        reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
        while link.cuts < 5:
            await trip_s(reader, writer, b"still here")
        writer.close()


@pytest.mark.system
async def test_a_link_in_its_own_process_relays_cuts_and_heals() -> None:
    async with echo() as server, LinkProcess(PROFILES["none"], "127.0.0.1", server.port) as link:
        reader, writer = await asyncio.open_connection("127.0.0.1", link.port)
        await trip_s(reader, writer, b"before")
        await link.cut()
        writer.write(b"during")
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(reader.read(1), 0.2)
        await link.heal()
        assert await asyncio.wait_for(reader.readexactly(6), SOON_S) == b"during"
        writer.close()
        await asyncio.wait_for(server.ended.wait(), SOON_S)
