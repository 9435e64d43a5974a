"""A robot with several addresses, against fake platforms behind links with different delays on 127.0.0.1."""

from __future__ import annotations

import asyncio
import json
import random
import time
from contextlib import AsyncExitStack
from dataclasses import replace

import pytest

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config import SessionSettings
from rse_pf.errors import Unauthorized, UsageError
from rse_pf.wire.server_session import CLOSE_REPLACED
from tests.kit.delaying_proxy import DelayingProxy
from tests.kit.fake_platform import FakePlatform, FakeSocket

pytestmark = pytest.mark.system

QUICK = SessionSettings(
    stall_timeout_s=0.6,
    ping_interval_s=0.1,
    ping_timeout_s=0.8,
)
TIMINGS = ConnectTimings(
    connect_timeout_s=1.0, reconnect_max_s=0.05, reconnect_long_max_s=0.2, region_hold_s=0.5
)
NEAR_S, FAR_S = 0.01, 0.06


class TwoRegions:
    """Two platforms, the first behind a link with a short delay, the second behind one with a long delay."""

    async def __aenter__(self) -> TwoRegions:
        self._stack = AsyncExitStack()
        self.changes: list[tuple[str, str]] = []
        self._stands_by = asyncio.Event()
        self.near, self.far = FakePlatform(), FakePlatform()
        self.near.landing, self.far.landing = "near-1", "far-1"
        await self._stack.enter_async_context(self.near)
        await self._stack.enter_async_context(self.far)
        self.near_link = await self._stack.enter_async_context(DelayingProxy(self.near.port, NEAR_S))
        self.far_link = await self._stack.enter_async_context(DelayingProxy(self.far.port, FAR_S))
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def both_joined(self) -> None:
        """Wait until the robot has a standby connection to the other region."""
        await asyncio.wait_for(self._stands_by.wait(), 5.0)

    def _changed(self, what, why):
        self.changes.append((what, why))
        if what == "stands-by":
            self._stands_by.set()

    def robot(self, settings=QUICK, timings=TIMINGS, **options):
        return client_sdk.connect(
            [self.far_link.url, self.near_link.url], settings=settings, timings=timings,
            random=random.Random(1),
            on_change=self._changed, **options,
        )  # fmt: skip


def ask(a_robot, value, **options):
    return asyncio.create_task(a_robot.call("echo", {"value": value}, **options))


async def asked_until(a_robot, server):
    """Send commands until the server named *server* answers one."""
    while (await ask(a_robot, 0, deadline_s=10)).server != server:
        await asyncio.sleep(0)


async def test_the_nearer_region_is_used_and_the_other_one_stands_by():
    async with TwoRegions() as regions:
        began = time.monotonic()
        async with regions.robot() as a_robot:
            assert time.monotonic() - began < 2.0
            assert (await ask(a_robot, 1)).server == "near-1"
            assert a_robot.stats.region == regions.near_link.url
            await regions.both_joined()

            assert not list(regions.far.commands())
            assert a_robot.stats.region_changes == 0


async def test_a_region_is_no_nearer_for_saying_that_all_of_the_time_was_its_own():
    async with TwoRegions() as regions:
        send = FakeSocket.send

        async def sends(socket, data):
            message = json.loads(data) if data[:1] == b"{" else {}
            if message.get("type") == "pong" and socket.server == "far-1":
                data = json.dumps({**message, "received_s": message["answered_s"] - 1.0}).encode()
            await send(socket, data)

        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(FakeSocket, "send", sends)
            regions.near_link.delay_s = 0.04
            async with regions.robot(codec="json") as a_robot:
                await regions.both_joined()
                until = time.monotonic() + 3 * TIMINGS.region_hold_s
                while time.monotonic() < until:
                    assert (await ask(a_robot, 1)).server == "near-1"


async def test_a_region_that_dies_is_left_at_once_and_no_command_is_lost():
    # Nobody would notice its silence before the deadlines of the commands.
    patient = replace(QUICK, stall_timeout_s=25.0, ping_interval_s=25.0, ping_timeout_s=25.0)
    async with TwoRegions() as regions, regions.robot(patient) as a_robot:
        await regions.both_joined()
        regions.near.hold = True
        held = [ask(a_robot, n, deadline_s=10) for n in range(8)]
        await regions.near.until(lambda: len(list(regions.near.commands())) == 8)
        await regions.near_link.die()

        answers = await asyncio.gather(*held)

        assert [answer.reply["value"] for answer in answers] == list(range(8))
        assert {answer.server for answer in answers} == {"far-1"}
        stats = a_robot.stats
        assert (stats.region, stats.region_changes, stats.duplicates) == (regions.far_link.url, 1, 0)
        assert regions.changes[0] == ("stands-by", "far-1")
        assert [what for what, _ in regions.changes[1:]] == ["link-lost", "link-back"]


async def test_a_region_that_falls_silent_is_left_although_its_sockets_stay_open():
    async with TwoRegions() as regions, regions.robot() as a_robot:
        await regions.both_joined()
        regions.near_link.is_stalled = True

        answer = await ask(a_robot, 1, deadline_s=10)

        assert answer.server == "far-1"


async def test_a_region_that_comes_back_is_used_again_once_it_was_nearer_for_long_enough():
    async with TwoRegions() as regions, regions.robot() as a_robot:
        await regions.both_joined()
        await regions.near_link.die()
        await asked_until(a_robot, "far-1")
        await regions.near_link.listen()

        await asked_until(a_robot, "near-1")

        stats = a_robot.stats
        assert (stats.region_changes, stats.failed, stats.duplicates) == (2, 0, 0)
        assert ("moved", "near-1") in regions.changes


async def test_a_region_that_gets_slow_is_left_without_a_gap_and_nothing_is_sent_twice():
    async with TwoRegions() as regions, regions.robot() as a_robot:
        await regions.both_joined()
        regions.near_link.delay_s = 0.2

        await asked_until(a_robot, "far-1")

        stats = a_robot.stats
        assert (stats.region_changes, stats.reconnects, stats.resent, stats.failed) == (1, 0, 0, 0)
        await regions.near.until(lambda: not regions.near.sockets[0].is_open)
        await regions.near.until(lambda: regions.near.open_sockets())


async def test_a_robot_that_one_region_does_not_know_uses_the_other_one():
    async with TwoRegions() as regions:
        regions.near.token, regions.far.token = "elsewhere", "mine"
        async with regions.robot(token="mine") as a_robot:
            assert (await ask(a_robot, 1)).server == "far-1"
            regions.far.token = "another"
            regions.far.open_sockets()[0].cut()

            with pytest.raises(Unauthorized):
                await ask(a_robot, 2, deadline_s=10)


async def test_two_addresses_of_one_platform_do_not_replace_each_other_for_ever():
    async with (
        TwoRegions() as regions,
        regions.robot(timings=replace(TIMINGS, region_hold_s=60.0)) as a_robot,
    ):
        await regions.both_joined()
        # What a platform does with the older of two connections of one robot.
        await regions.near.sockets[0].websocket.close(CLOSE_REPLACED, "replaced")

        assert (await ask(a_robot, 1)).server == "far-1"
        assert len(regions.near.handshakes) == 1
        regions.far.sockets[0].cut()
        assert (await ask(a_robot, 2, deadline_s=10)).reply == {"value": 2}


async def test_a_server_that_asks_a_standby_to_move_gets_it_closed_and_the_commands_go_on():
    async with TwoRegions() as regions, regions.robot() as a_robot:
        await regions.both_joined()
        regions.far.landing = "far-2"
        await regions.far.sockets[0].move()

        await regions.far.until(lambda: [each.server for each in regions.far.open_sockets()] == ["far-2"])

        assert (await ask(a_robot, 1)).server == "near-1"
        assert a_robot.stats.region_changes == 0


@pytest.mark.parametrize("urls", [[], ["ws://a/ws", "ws://a/ws"], [f"ws://{n}/ws" for n in range(5)]])
def test_no_address_the_same_twice_and_too_many_are_refused(urls):
    with pytest.raises(UsageError, match="addresses"):
        client_sdk.connect(urls)
