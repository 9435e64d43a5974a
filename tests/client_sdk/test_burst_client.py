"""A robot whose servers cannot answer asks the burst function, then itself, and says who answered."""

from __future__ import annotations

import asyncio
import socket
from random import Random
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config import BurstSettings, PlatformSettings, SessionSettings
from rse_pf.errors import Busy, Expired, NoConsensus
from rse_pf.pnp import solve_pnp
from rse_pf.pnp.problems import make_degenerate, make_problem
from rse_pf.services.builtin import builtin_services
from rse_pf.wire import Failure
from tests.kit.fake_burst_function import FakeBurst
from tests.kit.fake_peers import peer, proxy_to
from tests.kit.fake_platform import FakePlatform

FAST = SessionSettings(stall_timeout_s=0.4)
TIMINGS = ConnectTimings(reconnect_max_s=0.05, connect_timeout_s=0.5)
PROBLEM = make_problem(seed=5)
FRAME = (PROBLEM.points_world, PROBLEM.pixels, PROBLEM.camera)
BUDGET = 1000
PLATFORM = PlatformSettings()


def robot(url: str, **options: Any) -> client_sdk.Robot:
    return client_sdk.connect(
        url, settings=FAST, timings=TIMINGS, random=Random(1), **{"token": "a.b.c", **options}
    )


def own_solver(platform: FakePlatform) -> client_sdk.Robot:
    return robot(platform.url, offload=client_sdk.CloudFirst())


async def busy(_: object, command: Any) -> Failure:
    return Failure(id=command.id, code="busy", message="full", retry_after_ms=9e4)


def closed_port() -> tuple[socket.socket, str]:
    held = socket.socket()
    held.bind(("127.0.0.1", 0))
    return held, f"ws://127.0.0.1:{held.getsockname()[1]}/ws"


def platform_with(burst: FakeBurst, budget: int = BUDGET) -> FakePlatform:
    platform = FakePlatform(registry=builtin_services(PLATFORM))
    platform.burst = BurstSettings(url=burst.url, robot_commands_per_day=budget)
    return platform


async def test_for_a_busy_server_the_function_of_the_welcome_answers_with_the_same_token_and_bytes():
    async with FakeBurst() as burst, platform_with(burst) as platform, robot(platform.url) as client:
        platform.on_command = busy
        answer = await client.solve_pnp(*FRAME, deadline_s=5.0)

        assert (answer.source, answer.server) == ("burst", "lambda")
        assert answer.why == "the cloud answered busy"
        np.testing.assert_allclose(answer.solution.T_camera_world, PROBLEM.T_camera_world, atol=0.05)
        assert burst.headers[0]["authorization"] == "Bearer a.b.c"
        sent = platform.sockets[0].commands[0]
        assert burst.commands[0].service == sent.service
        assert burst.commands[0].payload == sent.payload
        assert 0 < burst.commands[0].deadline_ms <= 5000
        stats = client.stats
        assert (stats.answered_by_burst, stats.answered_by_robot, stats.failed) == (1, 0, 0)


async def test_a_function_behind_the_proxy_of_the_environment_answers(monkeypatch):
    asked: list[str] = []
    async with FakeBurst() as burst, platform_with(burst) as platform:
        platform.on_command = busy
        with peer(proxy_to(urlsplit(burst.url).port, asked)) as port:
            monkeypatch.setenv("http_proxy", f"http://127.0.0.1:{port}")
            async with robot(platform.url, burst_url="http://burst.invalid/burst") as client:
                answer = await client.solve_pnp(*FRAME, deadline_s=5.0)

    assert answer.source == "burst"
    assert asked[0].startswith("CONNECT burst.invalid:80 ")


async def test_a_server_that_answers_is_never_replaced():
    async with FakeBurst() as burst, platform_with(burst) as platform, robot(platform.url) as client:
        answer = await client.solve_pnp(*FRAME, deadline_s=5.0)

        assert (answer.source, burst.commands) == ("cloud", [])


async def test_a_late_server_is_replaced_while_the_function_can_still_be_in_time():
    solve_pnp(*FRAME)  # the first solution loads the solver

    async with FakeBurst() as burst, platform_with(burst) as platform, robot(platform.url) as client:
        platform.hold = True
        answer = await client.solve_pnp(*FRAME, deadline_s=1.0)

        assert (answer.source, answer.why) == ("burst", "the cloud did not answer in time")
        assert answer.round_trip_ms < 1000


async def test_a_robot_that_finds_no_server_at_all_asks_the_function_that_connect_names():
    held, url = closed_port()
    with held:
        async with FakeBurst() as burst, robot(url, burst_url=burst.url) as client:
            answer = await client.solve_pnp(*FRAME, deadline_s=5.0)

            assert (answer.source, answer.server) == ("burst", "lambda")
            assert answer.why == "no connection to the cloud"
            await asyncio.sleep(0)
            assert client.stats.unanswered == 0, "nothing is left to be sent later"


async def test_the_function_comes_before_the_robots_own_solver_and_the_solver_when_it_fails():
    async with FakeBurst() as burst, platform_with(burst) as platform, own_solver(platform) as client:
        platform.on_command = busy
        first = await client.solve_pnp(*FRAME, deadline_s=5.0)
        burst.status = 502
        second = await client.solve_pnp(*FRAME, deadline_s=5.0)

        assert (first.source, second.source) == ("burst", "robot")
        assert second.why == "the burst function answered busy"


async def test_the_budget_of_the_welcome_is_never_exceeded():
    async with (
        FakeBurst() as burst,
        platform_with(burst, budget=3) as platform,
        own_solver(platform) as client,
    ):
        platform.on_command = busy
        sources = [(await client.solve_pnp(*FRAME, deadline_s=5.0)).source for _ in range(6)]

        assert sources == ["burst"] * 3 + ["robot"] * 3
        assert len(burst.commands) == 3


async def test_a_function_that_fails_is_left_alone_by_the_breaker():
    async with FakeBurst() as burst, platform_with(burst) as platform, robot(platform.url) as client:
        platform.on_command = busy
        burst.status = 503
        for _ in range(6):
            with pytest.raises(Busy, match="full"):
                await client.solve_pnp(*FRAME, deadline_s=5.0)

        assert len(burst.commands) == 3


async def test_a_function_that_stays_silent_costs_no_more_than_the_deadline():
    async with FakeBurst() as burst, platform_with(burst) as platform, robot(platform.url) as client:
        platform.on_command = busy
        burst.hold = True
        began = asyncio.get_running_loop().time()
        with pytest.raises((Busy, Expired)):
            await client.solve_pnp(*FRAME, deadline_s=0.5)

        assert len(burst.commands) == 1
        assert asyncio.get_running_loop().time() - began < 1.5


async def test_a_frame_without_a_pose_is_not_solved_a_second_time():
    async with FakeBurst() as burst, platform_with(burst) as platform, own_solver(platform) as client:
        platform.on_command = busy
        noise = make_degenerate("noise", seed=1)
        with pytest.raises(NoConsensus):
            await client.solve_pnp(noise.points_world, noise.pixels, noise.camera, deadline_s=5)

        assert (len(burst.commands), client.stats.answered_by_robot) == (1, 0)


async def test_other_services_and_robots_without_a_token_do_not_ask():
    async with FakeBurst() as burst, platform_with(burst) as platform:
        platform.on_command = busy
        async with robot(platform.url) as client:
            with pytest.raises(Busy):
                await client.call("echo", {"value": 1}, deadline_s=1.0)
        async with robot(platform.url, token=None) as client:
            with pytest.raises(Busy):
                await client.solve_pnp(*FRAME, deadline_s=1.0)

        assert burst.commands == []


async def test_a_connection_is_kept_and_one_that_was_closed_meanwhile_costs_nothing():
    async with FakeBurst() as burst, platform_with(burst) as platform, robot(platform.url) as client:
        platform.on_command = busy
        for _ in range(2):
            await client.solve_pnp(*FRAME, deadline_s=5.0)
        assert burst.connections == 1
        burst.cut()
        assert (await client.solve_pnp(*FRAME, deadline_s=5.0)).source == "burst"

        assert (burst.connections, len(burst.commands)) == (2, 3)


@pytest.mark.parametrize("wrong", ["text/html", "application/rse-pf.v1.bin"])
async def test_what_is_not_our_function_does_not_answer_commands(wrong: str):
    async with FakeBurst() as burst, platform_with(burst) as platform, robot(platform.url) as client:
        platform.on_command = busy
        burst.content_type = wrong
        with pytest.raises(Busy):
            await client.solve_pnp(*FRAME, deadline_s=5.0)


@pytest.mark.parametrize("host", ["a..b", "a" * 64 + ".example"])
async def test_a_host_that_cannot_be_a_name_is_as_a_function_that_fails(host: str):
    url = f"http://{host}/burst"
    async with (
        FakePlatform(registry=builtin_services(PLATFORM)) as platform,
        robot(platform.url, burst_url=url) as client,
    ):
        platform.on_command = busy
        with pytest.raises(Busy):
            await client.solve_pnp(*FRAME, deadline_s=5.0)
