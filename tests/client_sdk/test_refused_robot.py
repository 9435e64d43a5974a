"""A robot that its servers refuse, or that nobody answers, goes on dialling and reconnects."""

from __future__ import annotations

import random
import socket
import time
from dataclasses import replace

import pytest

import client_sdk
from rse_pf.config import SessionSettings
from rse_pf.errors import Expired, Unauthorized
from rse_pf.wire.server_session import CLOSE_REVOKED
from tests.kit.fake_platform import FakePlatform
from tests.kit.quick_robots import QUICK, TIMINGS, answered, ask, robot

pytestmark = pytest.mark.system


async def test_after_a_cut_off_a_robot_that_signs_its_tokens_signs_one_of_a_later_second():
    signed = []

    async def token():
        signed.append(time.time())
        return f"t{len(signed)}"

    connecting = {"settings": SessionSettings(), "random": random.Random(1), "token": token}
    async with FakePlatform() as platform, client_sdk.connect(platform.url, **connecting) as a_robot:
        cut_off_s = time.time()
        await platform.sockets[0].websocket.close(CLOSE_REVOKED, "revoked")

        assert (await ask(a_robot, 1, deadline_s=10)).reply == {"value": 1}
        assert int(signed[-1]) > int(cut_off_s)
        assert platform.tokens_seen == ["t1", "t2"]
        assert time.time() - cut_off_s < 5.0


async def test_a_refusal_that_names_the_time_of_the_cut_off_is_followed_by_a_later_token():
    now_s, signed = [1000.4], []

    async def token():
        signed.append(now_s[0])
        return f"t{len(signed)}"

    async with FakePlatform() as platform:
        clock = {"wall_clock": lambda: now_s[0]}
        async with robot(platform.url, token=token, **clock) as a_robot:
            platform.refusal_members = {"cause": "cut-off", "valid_from_s": 1120.0}
            platform.refusals = [(401, None)] * 2
            platform.sockets[0].cut()
            await platform.until(lambda: not platform.refusals)
            with pytest.raises(Unauthorized):
                await ask(a_robot, 1, deadline_s=10)

            now_s[0] = 1120.1  # somebody set the clock of the robot

            assert (await answered(a_robot)).reply == {"value": 3}
            assert len(platform.tokens_seen) == 4  # a cut-off is no reason to ask for another token at once


@pytest.mark.parametrize("when", ["after the refusal", "while the refusal is reported"])
async def test_a_robot_whose_clock_is_set_right_is_tried_again_at_once(when):
    now_s = [1000.0]
    timings = replace(TIMINGS, reconnect_long_max_s=1000.0)

    async def token():
        return "t"

    def set_clock(event, detail):
        if event == "refused" and when == "while the refusal is reported":
            now_s[0] -= 120.0

    async with FakePlatform() as platform:
        connecting = client_sdk.connect(
            platform.url, token=token, settings=QUICK, timings=timings, random=random.Random(1),
            on_change=set_clock, wall_clock=lambda: now_s[0] + time.monotonic(),
        )  # fmt: skip
        async with connecting as a_robot:
            platform.refusal_members = {"cause": "not-yet-valid"}
            platform.refusals = [(401, None)]
            platform.sockets[0].cut()
            await platform.until(lambda: not platform.refusals)
            if when == "after the refusal":
                now_s[0] -= 120.0

            assert (await answered(a_robot)).reply == {"value": 3}


async def test_subscriptions_outlive_a_refusal():
    async with FakePlatform() as platform:
        platform.token = "right"
        async with robot(platform.url, token="right") as a_robot:
            updates = a_robot.subscribe("live/a")
            await platform.until(lambda: bool(platform.sockets[0].topics))
            platform.token = "another"
            platform.sockets[0].cut()
            await platform.until(lambda: len(platform.tokens_seen) > 2)
            platform.token = "right"
            await platform.until(lambda: len(platform.sockets) > 1 and bool(platform.sockets[1].topics))
            await platform.sockets[1].update("key", 7)

            assert await updates.next() == ("key", 7)


async def test_a_connection_that_nobody_answers_is_begun_anew_each_second_and_costs_no_allowance():
    async with FakePlatform() as platform, client_sdk.connect(platform.url) as a_robot:
        port = platform.port
        await platform.stop()
        backoff, spent = a_robot._connection._regions[0].backoff, []
        backoff.dialled = spent.append
        with socket.socket() as full:
            # Its backlog is full, so the kernel does not answer a SYN.
            full.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            full.bind(("127.0.0.1", port))
            full.listen(0)
            held = [socket.socket() for _ in range(2)]
            for each in held:
                each.setblocking(False)
                each.connect_ex(("127.0.0.1", port))
            spent.clear()
            for _ in range(6):
                with pytest.raises(Expired):
                    await ask(a_robot, 1, deadline_s=0.5)
            assert len(spent) <= 1
            for each in held:
                each.close()
        await platform.listen(port)
        free_s = time.monotonic()

        assert (await ask(a_robot, 1, deadline_s=10)).reply == {"value": 1}
        assert time.monotonic() - free_s <= 2.5
        await platform.stop()
