"""The robot's sockets against real ones on 127.0.0.1: reconnect, move, refusals, malformed input."""

from __future__ import annotations

import asyncio
import random
import socket
import time

import pytest

import client_sdk
from client_sdk.network.handshake import websocket_options
from rse_pf.errors import (
    Conflict,
    ConnectError,
    Expired,
    Forbidden,
    Unauthorized,
    UsageError,
)
from rse_pf.wire.server_session import CLOSE_REPLACED, CLOSE_REVOKED, CLOSE_TOKEN_OVER, MAX_BAD_MESSAGES
from tests.kit.fake_platform import FakePlatform
from tests.kit.quick_robots import QUICK, TIMINGS, answered, ask, robot

pytestmark = pytest.mark.system


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
async def test_fifty_commands_share_one_socket_and_each_gets_its_own_answer(codec):
    async with FakePlatform() as platform, robot(platform.url, codec=codec) as a_robot:
        answers = await asyncio.gather(*(ask(a_robot, n) for n in range(50)))

        assert [answer.reply["value"] for answer in answers] == list(range(50))
        assert len(platform.sockets) == 1
        assert {answer.server for answer in answers} == {"server-a"}


async def test_a_socket_that_dies_under_load_loses_no_command():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        platform.hold = True
        asked = [ask(a_robot, n, deadline_s=10) for n in range(20)]
        for death in range(3):
            await platform.until(lambda n=death: len(platform.sockets) > n and platform.sockets[-1].commands)
            platform.hold = death < 2
            platform.sockets[-1].cut()

        answers = await asyncio.gather(*asked)

        assert [answer.reply["value"] for answer in answers] == list(range(20))
        assert a_robot.stats.reconnects == 3
        assert a_robot.stats.resent >= 8
        assert a_robot.stats.answered == 20


async def test_a_load_balancer_that_comes_back_finds_the_robot_waiting():
    platform = FakePlatform()
    await platform.listen()
    port = platform.port
    async with robot(platform.url) as a_robot:
        await platform.stop()
        asked = ask(a_robot, "after the cut", deadline_s=10)
        await asyncio.sleep(0)
        await platform.listen(port)

        assert (await asked).reply == {"value": "after the cut"}
        await platform.stop()


async def test_a_stalled_server_is_left_in_time_although_its_socket_stays_open():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        platform.sockets[0].muted = True
        began = time.monotonic()

        answer = await ask(a_robot, 1, deadline_s=10)

        assert answer.reply == {"value": 1}
        assert time.monotonic() - began >= QUICK.stall_timeout_s
        assert a_robot.stats.reconnects == 1
        assert "silence" in a_robot.stats.last_error or "no pong" in a_robot.stats.last_error


async def test_a_deadline_holds_whatever_the_server_does():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        platform.hold = True
        began = time.monotonic()
        later = ask(a_robot, 2, deadline_s=10)

        with pytest.raises(Expired):
            await ask(a_robot, 1, deadline_s=0.1)

        assert time.monotonic() - began >= 0.1
        assert not later.done()
        later.cancel()


async def test_a_move_opens_the_new_socket_first_and_finishes_what_the_old_one_holds():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        platform.hold = True
        held = ask(a_robot, "old", deadline_s=10)
        old = platform.sockets[0]
        await platform.until(lambda: old.commands)
        platform.hold, platform.landing = False, "server-b"

        await old.move()
        await platform.until(lambda: len(platform.sockets) == 2)
        assert old.is_open
        while a_robot.stats.server != "server-b":
            await ask(a_robot, "meanwhile")
        assert (await ask(a_robot, "new")).server == "server-b"
        await old.answer(platform.result(old.commands[0], "server-a"))

        assert (await held).server == "server-a"
        await old.websocket.wait_closed()
        assert old.websocket.close_code == 1000
        assert (a_robot.stats.moves, a_robot.stats.reconnects, a_robot.stats.resent) == (1, 0, 0)


async def test_a_move_that_reaches_the_same_server_keeps_its_socket_and_is_retried():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        await platform.sockets[0].move()
        await platform.until(lambda: len(platform.sockets) >= 3)
        assert platform.sockets[0].is_open
        assert (await ask(a_robot, 1)).reply == {"value": 1}
        assert not platform.sockets[1].commands
        platform.landing = "server-b"

        await platform.until(lambda: platform.sockets[-1].server == "server-b")
        await platform.sockets[0].websocket.wait_closed()

        assert (await ask(a_robot, 2)).server == "server-b"
        assert a_robot.stats.moves == 1


async def test_a_server_that_dies_during_a_move_loses_nothing():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        platform.hold = True
        held = ask(a_robot, "kept", deadline_s=10)
        await platform.until(lambda: platform.sockets[0].commands)
        platform.hold = False
        await platform.sockets[0].move()
        await platform.until(lambda: len(platform.sockets) >= 2)
        platform.sockets[0].cut()

        assert (await held).reply == {"value": "kept"}


async def test_a_wrong_token_is_reported_at_once():
    async with FakePlatform() as platform:
        platform.token = "right"
        with pytest.raises(Unauthorized) as raised:
            await robot(platform.url, token="wrong").__aenter__()

        assert "rse-pf token issue" in raised.value.hint
        assert "wrong" not in str(raised.value).replace("missing, wrong or expired", "")
        assert platform.tokens_seen == ["wrong"]


async def test_a_token_callable_is_called_once_more_when_its_token_has_expired():
    tokens = iter(["over", "fresh", "second"])

    async def token():
        return next(tokens)

    async with FakePlatform() as platform:
        platform.token = "fresh"
        async with robot(platform.url, token=token) as a_robot:
            platform.token = "second"
            await platform.sockets[0].websocket.close(CLOSE_TOKEN_OVER, "token over")

            assert (await ask(a_robot, 1, deadline_s=5)).reply == {"value": 1}
            assert platform.tokens_seen == ["over", "fresh", "second"]


async def test_a_token_that_is_refused_later_ends_the_calls_and_the_robot_comes_back_when_it_is_accepted():
    async with FakePlatform() as platform:
        platform.token = "right"
        changes = []
        async with robot(
            platform.url, token="right", on_change=lambda *change: changes.append(change)
        ) as a_robot:
            platform.hold = True
            waiting = ask(a_robot, 1, deadline_s=10)
            await platform.until(lambda: platform.sockets[0].commands)
            assert a_robot.failure is None
            platform.token = "another"
            platform.sockets[0].cut()

            with pytest.raises(Unauthorized):
                await waiting
            with pytest.raises(Unauthorized):
                await ask(a_robot, 2)
            assert isinstance(a_robot.failure, Unauthorized)
            assert [change for change, _ in changes] == ["link-lost", "refused"]
            assert changes[-1][1] == a_robot.failure.message

            refused = len(platform.tokens_seen)
            await platform.until(lambda: len(platform.tokens_seen) > refused + 1)
            platform.token, platform.hold = "right", False
            await platform.until(lambda: len(platform.sockets) == 2 and platform.sockets[1].is_welcomed)
            answer = await answered(a_robot)

            assert answer.reply == {"value": 3}
            assert a_robot.failure is None
            assert [change for change, _ in changes] == ["link-lost", "refused", "link-back"]


async def test_a_robot_that_is_revoked_does_not_come_back_to_a_server_that_has_not_heard_of_it():
    async with FakePlatform() as platform, robot(platform.url, token="revoked") as a_robot:
        platform.hold = True
        waiting = ask(a_robot, 1, deadline_s=10)
        await platform.until(lambda: platform.sockets[0].commands)
        await platform.sockets[0].websocket.close(CLOSE_REVOKED, "revoked")

        with pytest.raises(Unauthorized, match="revoked"):
            await waiting
        assert platform.tokens_seen == ["revoked"]


async def test_a_token_callable_that_fails_is_called_again():
    tokens = iter([OSError("issuer is away"), OSError("still"), "fresh"])

    async def token():
        result = next(tokens)
        if isinstance(result, OSError):
            raise result
        return result

    async with FakePlatform() as platform, robot(platform.url, token=token) as a_robot:
        assert (await ask(a_robot, 1)).reply == {"value": 1}


async def test_a_full_server_is_not_retried_before_its_retry_after():
    async with FakePlatform() as platform:
        platform.refusals = [(503, 1)]
        async with robot(platform.url) as a_robot:
            assert (await ask(a_robot, 1)).reply == {"value": 1}

        first, second = platform.handshakes
        assert second - first >= 1.0


@pytest.mark.parametrize(("status", "error"), [(403, Forbidden), (404, ConnectError), (400, ConnectError)])
async def test_a_final_refusal_is_not_retried(status, error):
    async with FakePlatform() as platform:
        platform.refusals = [(status, None)]
        with pytest.raises(error):
            await robot(platform.url).__aenter__()
        assert len(platform.handshakes) == 1


async def test_what_a_firewall_refuses_ends_neither_a_connect_nor_a_robot():
    async with FakePlatform() as platform:
        platform.refuses_as_firewall = True
        platform.refusals = [(403, None), (401, None)]
        async with robot(platform.url, token="mine") as a_robot:
            platform.refusals = [(403, None), (401, None), (403, 1), (429, None)]
            platform.sockets[0].cut()

            assert (await ask(a_robot, 1, deadline_s=15)).reply == {"value": 1}

        assert len(platform.handshakes) == 8


async def test_a_server_that_never_sends_welcome_is_a_connect_error():
    async with FakePlatform() as platform:
        platform.welcomes = False
        began = time.monotonic()
        with pytest.raises(ConnectError, match="sends no Welcome"):
            await robot(platform.url).__aenter__()
        assert time.monotonic() - began < TIMINGS.connect_timeout_s * 6


async def test_an_address_without_a_server_is_one_line_with_a_hint():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"ws://127.0.0.1:{free.getsockname()[1]}/ws"

    with pytest.raises(ConnectError) as raised:
        await robot(url).__aenter__()
    assert "\n" not in raised.value.message
    assert url in raised.value.message
    assert "rse-pf local" in raised.value.hint


@pytest.mark.parametrize("url", ["http://localhost/ws", "localhost:8700", "ws://", "ws://h:99999/ws"])
def test_an_invalid_address_is_refused_before_anything_is_opened(url):
    with pytest.raises(UsageError, match="not a WebSocket address"):
        robot(url)


def test_neither_an_address_nor_an_enrolment_is_refused_with_both_ways():
    with pytest.raises(UsageError, match="either an address or an enrolment"):
        robot("")


async def test_invalid_messages_of_a_server_affect_no_command_up_to_a_limit():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        first = platform.sockets[0]
        for _ in range(MAX_BAD_MESSAGES):
            await first.send(b"\x00malformed")
        assert (await ask(a_robot, 1)).reply == {"value": 1}
        assert a_robot.stats.reconnects == 0

        await first.send(b"\x00malformed")
        await platform.until(lambda: len(platform.sockets) == 2)
        assert (await ask(a_robot, 2)).reply == {"value": 2}


async def test_a_message_above_the_limit_costs_a_reconnect_and_no_command():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        await platform.sockets[0].send(bytes(QUICK.max_message_bytes + 1))

        assert (await ask(a_robot, 1, deadline_s=5)).reply == {"value": 1}


async def test_another_robot_with_the_same_token_is_reported_as_a_conflict_and_tried_again_later():
    async with FakePlatform() as platform, robot(platform.url) as a_robot:
        platform.hold = True
        waiting = ask(a_robot, 1, deadline_s=10)
        await platform.until(lambda: platform.sockets[0].commands)
        await platform.sockets[0].websocket.close(CLOSE_REPLACED, "replaced")

        with pytest.raises(Conflict):
            await waiting
        assert len(platform.sockets) == 1
        platform.hold = False

        assert (await answered(a_robot)).reply == {"value": 3}
        assert platform.handshakes[1] - platform.handshakes[0] >= 0.2


async def test_reconnects_spread_over_the_whole_back_off(monkeypatch):
    monkeypatch.setattr("client_sdk.network.backoff.RECONNECT_BASE_S", 0.4)

    async with FakePlatform() as platform:
        robots = [client_sdk.connect(platform.url, random=random.Random(seed)) for seed in range(30)]
        for each in robots:
            await each.__aenter__()
        platform.handshakes.clear()
        began = time.monotonic()
        for each in platform.open_sockets():
            each.cut()
        await platform.until(lambda: len(platform.handshakes) == 30)
        delays = sorted(at - began for at in platform.handshakes)
        for each in robots:
            await each.close()

        assert delays[-1] - delays[0] > 0.2
        assert delays[15] > 0.1


def test_every_socket_is_opened_without_compression_and_with_our_limits():
    options = websocket_options(QUICK, TIMINGS)

    assert options["compression"] is None
    assert options["ping_interval"] is None
    assert options["proxy"] is None
    assert options["max_size"] == QUICK.max_message_bytes
