"""The robot against a fake server over real sockets."""

from __future__ import annotations

import asyncio
import random
import socket
from collections.abc import Coroutine
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import server_sessions
from fakes import FakeRobot, FakeServer, answer_at_once, answer_nothing

import client_sdk
from client_sdk.network.connection import Connection
from rse_pf.config import PnpSettings, SessionSettings
from rse_pf.errors import (
    Busy,
    ConnectError,
    Disconnected,
    Expired,
    Stale,
    Unauthorized,
    UnknownService,
    UsageError,
)
from rse_pf.pnp.problems import make_problem
from rse_pf.services import pnp
from rse_pf.wire import Command, Failure, Result

FAST = SessionSettings(reconnect_max_s=0.05, stall_timeout_s=0.4, ping_interval_s=0.2)


def run(work: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(work, 30))


def connect(server: FakeServer, **options: Any) -> client_sdk.Robot:
    options = {"settings": FAST, "random": random.Random(1), **options}
    return client_sdk.connect(server.url, **options)


@pytest.mark.parametrize("codec", ["zlib", "json", "bin"])
def test_a_call_gets_its_reply_in_every_codec(codec: str) -> None:
    async def work() -> None:
        async with FakeServer().running() as server, connect(server, codec=codec) as robot:
            answer = await robot.call("echo", {"value": [1, "two", 3.5]})
            assert answer.reply == {"value": [1, "two", 3.5]}
            assert answer.source == "cloud"
            assert answer.server == "fake"

    run(work())


def test_many_calls_share_one_socket() -> None:
    async def work() -> None:
        async with FakeServer().running() as server, connect(server) as robot:
            answers = await asyncio.gather(*(robot.call("echo", {"value": i}) for i in range(8)))
            assert [answer.reply["value"] for answer in answers] == list(range(8))
            assert len(server.robots) == 1
            assert robot.stats.answered == 8

    run(work())


def test_a_failure_of_the_cloud_is_raised_as_its_own_type() -> None:
    async def work() -> None:
        async with FakeServer().running() as server, connect(server) as robot:
            with pytest.raises(UnknownService, match="pmp"):
                await robot.call("pmp", {})
            assert robot.stats.failures_by_code == {"unknown-service": 1}

    run(work())


def test_the_deadline_ends_a_command_that_nobody_answers() -> None:
    async def work() -> None:
        async with FakeServer(answer=answer_nothing).running() as server, connect(server) as robot:
            with pytest.raises(Expired):
                await robot.call("echo", {}, deadline_s=0.1)
            assert robot.stats.unanswered == 0

    run(work())


def test_a_lost_socket_loses_no_command() -> None:
    async def work() -> None:
        async with FakeServer(answer=answer_nothing).running() as server, connect(server) as robot:
            calls = [asyncio.create_task(robot.call("echo", {"value": i})) for i in range(5)]
            await server.until(lambda: len(server.all_commands) == 5)
            server.answer = answer_at_once
            server.cut()
            answers = await asyncio.gather(*calls)
            assert [answer.reply["value"] for answer in answers] == list(range(5))
            assert robot.stats.reconnects == 1
            assert robot.stats.resent == 5

    run(work())


def test_a_stalled_server_is_left_although_its_socket_stays_open() -> None:
    async def work() -> None:
        async with FakeServer().running() as server, connect(server) as robot:
            await robot.call("echo", {})
            server.deaf = True
            call = asyncio.create_task(robot.call("echo", {"value": 1}, deadline_s=5))
            first = server.robots[0]
            await server.until(lambda: first not in server.robots)
            server.deaf = False
            assert (await call).reply == {"value": 1}

    run(work())


def test_a_late_answer_of_an_old_socket_is_not_delivered_twice() -> None:
    async def work() -> None:
        def twice(server: FakeServer, robot: FakeRobot, command: Command) -> Result | Failure | None:
            answer = answer_at_once(server, robot, command)
            if answer is not None:
                asyncio.get_running_loop().create_task(
                    robot.send([server_sessions.answer(robot.session, answer)])
                )
            return answer

        async with FakeServer(answer=twice).running() as server, connect(server) as robot:
            await robot.call("echo", {"value": 1})
            await robot.call("echo", {"value": 2})
            await robot.call("echo", {"value": 3})
            assert robot.stats.answered == 3
            assert robot.stats.dropped_answers >= 1

    run(work())


def test_an_older_answer_of_a_stream_is_stale() -> None:
    async def work() -> None:
        held: list[tuple[FakeRobot, Command]] = []

        def hold_first(server: FakeServer, robot: FakeRobot, command: Command) -> Result | Failure | None:
            if not held:
                held.append((robot, command))
                return None
            return answer_at_once(server, robot, command)

        async with FakeServer(answer=hold_first).running() as server, connect(server) as robot:
            old = asyncio.create_task(robot.call("echo", {"value": "old"}, stream="pose"))
            await server.until(lambda: len(held) == 1)
            await robot.call("echo", {"value": "new"}, stream="pose")
            fake, command = held[0]
            answer = answer_at_once(server, fake, command)
            assert answer is not None
            await fake.send([server_sessions.answer(fake.session, answer)])
            with pytest.raises(Stale):
                await old

    run(work())


def test_moves_to_another_server_before_it_leaves_the_old_one() -> None:
    async def work() -> None:
        async with FakeServer("old").running() as server, connect(server) as robot:
            await robot.call("echo", {})
            old = server.robots[0]
            server.name = "new"
            await old.send(old.session.move("drain", 5000))
            await server.until(lambda: old not in server.robots)
            assert (await robot.call("echo", {})).server == "new"
            assert robot.stats.moves == 1
            assert robot.stats.reconnects == 0

    run(work())


def test_stays_where_it_is_when_a_move_lands_on_the_same_server() -> None:
    async def work() -> None:
        async with FakeServer("same").running() as server, connect(server) as robot:
            await robot.call("echo", {})
            old = server.robots[0]
            await old.send(old.session.move("rebalance", 300))
            await server.until(lambda: len(server.tokens) >= 3)
            assert old in server.robots
            assert (await robot.call("echo", {"value": 7})).reply == {"value": 7}
            assert robot.stats.moves == 0

    run(work())


def test_a_refused_token_is_unauthorized() -> None:
    async def work() -> None:
        async with FakeServer().running() as server:
            server.refuse = (401, {})
            with pytest.raises(Unauthorized):
                async with connect(server, token="bad"):
                    pass
            assert server.tokens == ["Bearer bad"]

    run(work())


def test_a_token_callable_is_asked_again_once() -> None:
    async def work() -> None:
        async with FakeServer().running() as server:
            server.refuse = (401, {})
            given = iter(["first", "second", "third"])

            async def token() -> str:
                return next(given)

            with pytest.raises(Unauthorized):
                async with connect(server, token=token):
                    pass
            assert server.tokens == ["Bearer first", "Bearer second"]

    run(work())


def test_an_address_without_a_server_is_one_line_with_a_hint() -> None:
    async def work() -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            url = f"ws://127.0.0.1:{free.getsockname()[1]}/ws"
            with pytest.raises(ConnectError) as caught:
                async with client_sdk.connect(url, settings=FAST):
                    pass
        assert "rse-pf local" in caught.value.hint

    run(work())


@pytest.mark.parametrize("url", ["http://127.0.0.1/ws", "127.0.0.1:8700", "ws://", ""])
def test_an_invalid_address_is_refused_at_once(url: str) -> None:
    with pytest.raises(UsageError):
        client_sdk.connect(url)


def test_an_unknown_codec_is_refused_at_once() -> None:
    with pytest.raises(UsageError, match="gzip"):
        client_sdk.connect("ws://127.0.0.1/ws", codec="gzip")


def test_calls_outside_the_connection_are_disconnected() -> None:
    async def work() -> None:
        async with FakeServer().running() as server:
            robot = connect(server)
            with pytest.raises(Disconnected):
                await robot.call("echo", {})
            async with robot:
                await robot.call("echo", {})
            with pytest.raises(Disconnected):
                await robot.call("echo", {})

    run(work())


def test_closing_ends_what_still_waits() -> None:
    async def work() -> None:
        async with FakeServer(answer=answer_nothing).running() as server:
            async with connect(server) as robot:
                call = asyncio.create_task(robot.call("echo", {}))
                await server.until(lambda: len(server.all_commands) == 1)
            with pytest.raises(Disconnected):
                await call

    run(work())


def test_busy_is_retried_within_the_deadline() -> None:
    async def work() -> None:
        def busy_once(server: FakeServer, robot: FakeRobot, command: Command) -> Result | Failure | None:
            if len(server.all_commands) == 1:
                return Failure(id=command.id, code="busy", message="full", retry_after_ms=20)
            return answer_at_once(server, robot, command)

        async with FakeServer(answer=busy_once).running() as server, connect(server) as robot:
            assert (await robot.call("echo", {"value": 1})).reply == {"value": 1}

    run(work())


def test_busy_beyond_the_deadline_is_raised() -> None:
    async def work() -> None:
        def busy(server: FakeServer, robot: FakeRobot, command: Command) -> Result | Failure | None:
            return Failure(id=command.id, code="busy", message="full", retry_after_ms=9000)

        async with FakeServer(answer=busy).running() as server, connect(server) as robot:
            with pytest.raises(Busy) as caught:
                await robot.call("echo", {}, deadline_s=1)
            assert caught.value.retry_after_ms == 9000

    run(work())


def test_cloud_first_answers_from_the_robot_when_the_cloud_is_late_and_says_so() -> None:
    async def work() -> None:
        problem = make_problem(seed=3)
        server = FakeServer(answer=answer_nothing)
        async with server.running(), connect(server, offload=client_sdk.CloudFirst()) as robot:
            answer = await robot.solve_pnp(
                problem.points_world, problem.pixels, problem.camera, deadline_s=1.0
            )
            assert answer.source == "robot"
            assert "did not answer in time" in answer.why
            assert answer.round_trip_ms < 1300
            np.testing.assert_allclose(answer.solution.T_camera_world, problem.T_camera_world, atol=0.05)
            assert robot.stats.answered_by_robot == 1

    run(work())


def test_the_robot_and_the_cloud_solve_the_same_numbers() -> None:
    async def work() -> None:
        problem = make_problem(seed=4)
        server = FakeServer()
        pnp.register(server.registry, PnpSettings())
        async with server.running(), connect(server, offload=client_sdk.CloudFirst()) as robot:
            args = (problem.points_world, problem.pixels, problem.camera)
            cloud = await robot.solve_pnp(*args, deadline_s=5)
            server.answer = answer_nothing
            own = await robot.solve_pnp(*args, deadline_s=1.0)
        assert (cloud.source, own.source) == ("cloud", "robot")
        np.testing.assert_array_equal(cloud.solution.T_camera_world, own.solution.T_camera_world)
        np.testing.assert_array_equal(cloud.solution.inliers, own.solution.inliers)

    run(work())


def test_stats_report_where_the_time_went() -> None:
    async def work() -> None:
        async with FakeServer().running() as server, connect(server) as robot:
            for i in range(5):
                await robot.call("echo", {"value": i})
            await server.until(lambda: len(server.all_commands) == 5)
            stats = robot.stats
            assert stats.sent == stats.answered == 5
            assert stats.server == "fake"
            assert stats.bytes_out > 0
            assert stats.bytes_in > 0
            assert stats.round_trip_ms.p50 is not None
            assert stats.round_trip_ms.p50 > 0

    run(work())


def test_a_connection_is_not_opened_by_its_constructor() -> None:
    settings = replace(FAST)
    robot = client_sdk.connect("ws://127.0.0.1:1/ws", settings=settings)
    assert isinstance(robot._connection, Connection)
    assert robot.stats.server == ""
