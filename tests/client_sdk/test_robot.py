"""The robot against a fake server over real sockets."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import numpy as np
import pytest

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config import PnpSettings, SessionSettings
from rse_pf.errors import (
    Disconnected,
    Stale,
    Unauthorized,
)
from rse_pf.pnp.problems import make_problem
from rse_pf.services import pnp
from rse_pf.wire import Command, Failure, Result
from tests.kit import server_sessions
from tests.kit.fakes import FakeRobot, FakeServer, answer_at_once, answer_nothing

FAST = SessionSettings(stall_timeout_s=0.4, ping_interval_s=0.2)


def connect(server: FakeServer, **options: Any) -> client_sdk.Robot:
    options = {
        "settings": FAST,
        "timings": ConnectTimings(reconnect_max_s=0.05),
        "random": random.Random(1),
        **options,
    }
    return client_sdk.connect(server.url, **options)


async def test_an_older_answer_of_a_stream_is_stale() -> None:
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


async def test_a_token_callable_is_asked_again_once() -> None:
    async with FakeServer().running() as server:
        server.refuse = (401, {})
        given = iter(["first", "second", "third"])

        async def token() -> str:
            return next(given)

        with pytest.raises(Unauthorized):
            async with connect(server, token=token):
                pass
        assert server.tokens == ["Bearer first", "Bearer second"]


async def test_calls_outside_the_connection_are_disconnected() -> None:
    async with FakeServer().running() as server:
        robot = connect(server)
        with pytest.raises(Disconnected):
            await robot.call("echo", {})
        async with robot:
            await robot.call("echo", {})
        with pytest.raises(Disconnected):
            await robot.call("echo", {})


async def test_busy_is_retried_within_the_deadline() -> None:
    def busy_once(server: FakeServer, robot: FakeRobot, command: Command) -> Result | Failure | None:
        if len(server.all_commands) == 1:
            return Failure(id=command.id, code="busy", message="full", retry_after_ms=20)
        return answer_at_once(server, robot, command)

    async with FakeServer(answer=busy_once).running() as server, connect(server) as robot:
        assert (await robot.call("echo", {"value": 1})).reply == {"value": 1}


async def test_cloud_first_answers_from_the_robot_when_the_cloud_is_late_and_says_so() -> None:
    problem = make_problem(seed=3)
    server = FakeServer(answer=answer_nothing)
    async with server.running(), connect(server, offload=client_sdk.CloudFirst()) as robot:
        answer = await robot.solve_pnp(problem.points_world, problem.pixels, problem.camera, deadline_s=1.0)
        assert answer.source == "robot"
        assert "did not answer in time" in answer.why
        assert answer.round_trip_ms < 1300
        np.testing.assert_allclose(answer.solution.T_camera_world, problem.T_camera_world, atol=0.05)
        assert robot.stats.answered_by_robot == 1


async def test_the_robot_and_the_cloud_solve_the_same_numbers() -> None:
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
