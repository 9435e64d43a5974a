"""Who answers a command, what its caller receives, and what the robot counts."""

from __future__ import annotations

import asyncio
from random import Random

import pytest

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.errors import (
    BadMessage,
    Busy,
    LimitExceeded,
    NoConsensus,
    TooFewCorrespondences,
    UsageError,
)
from rse_pf.pnp.problems import make_degenerate, make_problem
from rse_pf.services.builtin import builtin_services
from rse_pf.services.echo import EchoReply
from rse_pf.wire import Failure
from tests.kit.fake_platform import FakePlatform, echo_services

FAST = SessionSettings(stall_timeout_s=0.4)
OWN_ECHO = client_sdk.CloudFirst(registry=echo_services(), robot_solve_s=0.01)


def connect(platform, **options):
    return client_sdk.connect(
        platform.url, settings=FAST, timings=ConnectTimings(reconnect_max_s=0.05), random=Random(1), **options
    )


async def test_a_typed_reply_comes_typed_and_a_wrong_type_is_a_bad_message():
    async with FakePlatform() as platform, connect(platform) as robot:
        typed = await robot.call("echo", {"value": 3}, EchoReply)
        with pytest.raises(BadMessage):
            await robot.call("echo", {"value": 3}, client_sdk.Stats)

        assert typed.reply == EchoReply(value=3)
        assert robot.stats.failures_by_code == {"bad-message": 1}


async def test_the_hint_and_the_pause_of_a_failure_reach_the_caller():
    async def busy(_, command):
        return Failure(id=command.id, code="busy", message="full", hint="later", retry_after_ms=9e4)

    async with FakePlatform() as platform, connect(platform) as robot:
        platform.on_command = busy
        with pytest.raises(Busy, match="full") as raised:
            await robot.call("echo", {}, deadline_s=1)

        assert (raised.value.hint, raised.value.retry_after_ms) == ("later", 9e4)


async def test_a_cancelled_call_is_forgotten_and_not_sent_again():
    async with FakePlatform() as platform, connect(platform) as robot:
        platform.hold = True
        call = asyncio.create_task(robot.call("echo", {"value": "gone"}))
        await platform.until(lambda: platform.sockets[0].commands)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call
        platform.hold = False
        platform.sockets[0].cut()

        assert (await robot.call("echo", {"value": "here"})).reply == {"value": "here"}
        assert [command.payload for command in platform.sockets[1].commands] == [{"value": "here"}]
        assert robot.stats.unanswered == 0


@pytest.mark.parametrize("deadline_s", [0, -1, float("nan"), float("inf"), 1e9])
async def test_a_deadline_out_of_range_is_refused(deadline_s):
    async with FakePlatform() as platform, connect(platform) as robot:
        with pytest.raises(UsageError, match="deadline_s"):
            await robot.call("echo", {}, deadline_s=deadline_s)


async def test_a_command_that_is_too_large_is_reported_with_both_numbers_and_never_sent():
    async with FakePlatform() as platform, connect(platform, codec="json") as robot:
        with pytest.raises(LimitExceeded, match=r"\d+ bytes is above 262144"):
            await robot.call("echo", {"value": "x" * 300_000})

        assert not list(platform.commands())


async def test_the_cloud_answers_when_it_can_although_the_robot_could_too():
    async with FakePlatform() as platform, connect(platform, offload=OWN_ECHO) as robot:
        answer = await robot.call("echo", {"value": 1}, deadline_s=2)

        assert (answer.source, answer.server, answer.why) == ("cloud", "server-a", "")


async def test_the_robot_answers_for_a_busy_cloud_and_says_why():
    async def busy(_, command):
        return Failure(id=command.id, code="busy", message="full", retry_after_ms=9e4)

    async with FakePlatform() as platform, connect(platform, offload=OWN_ECHO) as robot:
        platform.on_command = busy
        answer = await robot.call("echo", {"value": 1}, deadline_s=2)

        assert (answer.source, answer.server, answer.reply) == ("robot", "robot", {"value": 1})
        assert answer.why == "the cloud answered busy"
        assert robot.stats.answered_by_robot == 1
        assert robot.stats.failed == 0


async def test_the_robot_answers_at_once_while_there_is_no_connection():
    async with FakePlatform() as platform, connect(platform, offload=OWN_ECHO) as robot:
        platform.refusals = [(503, None)] * 1000
        platform.sockets[0].cut()
        await platform.until(lambda: len(platform.handshakes) > 1)
        answer = await robot.call("echo", {"value": 1}, deadline_s=2)

        assert (answer.source, answer.why) == ("robot", "no connection to the cloud")


async def test_after_late_answers_the_robot_starts_at_once_and_the_cloud_wins_again_when_it_is_quick():
    async with FakePlatform() as platform, connect(platform, offload=OWN_ECHO) as robot:
        platform.hold = True
        late = await robot.call("echo", {"value": 1}, deadline_s=1.5)
        while "cloud takes" not in (await robot.call("echo", {"value": 2}, deadline_s=1.5)).why:
            pass
        platform.hold = False
        sources = {(await robot.call("echo", {"value": 3}, deadline_s=5)).source for _ in range(3)}

        assert late.why == "the cloud did not answer in time"
        assert sources == {"cloud"}


async def test_a_frame_without_a_pose_is_no_reason_to_solve_it_again():
    registry = builtin_services(PlatformSettings())
    async with FakePlatform(registry=registry) as platform:
        offload = client_sdk.CloudFirst(registry=registry)
        async with connect(platform, offload=offload) as robot:
            noise = make_degenerate("noise", seed=1)
            with pytest.raises(NoConsensus):
                await robot.solve_pnp(noise.points_world, noise.pixels, noise.camera, deadline_s=5)
            good = make_problem(seed=1)
            with pytest.raises(TooFewCorrespondences):
                await robot.solve_pnp(good.points_world[:3], good.pixels[:3], good.camera, deadline_s=5)

            assert robot.stats.answered_by_robot == 0
