"""First mistakes of new users: a token with white space, and a platform that is not started."""

from __future__ import annotations

import asyncio
import random
import socket
from typing import Any

import numpy as np
import pytest

import client_sdk
from client_sdk.network.bearer_token import strip_token
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.transfer.data_client import DataClient
from rse_pf.errors import ConnectError, Unauthorized
from rse_pf.pnp.problems import make_problem
from tests.kit.fake_platform import FakePlatform

TIMINGS = ConnectTimings(connect_timeout_s=0.5, reconnect_max_s=0.05)
SECRET = "eyJhbGciOi.JFZERTQS.c2VjcmV0"


def robot(url: str, **options: Any) -> client_sdk.Robot:
    return client_sdk.connect(url, timings=TIMINGS, random=random.Random(1), **options)


@pytest.mark.parametrize("around", ["{}\n", " {}", "\t{}\r\n"])
def test_white_space_around_a_token_does_not_count(around: str) -> None:
    assert strip_token(around.format(SECRET)) == SECRET


@pytest.mark.parametrize("wrong", [f"{SECRET}\n{SECRET}", f"{SECRET} x", f"{SECRET}\u00e9", "", " ", 7, None])
def test_what_no_header_can_hold_is_refused_without_showing_it(wrong: object) -> None:
    with pytest.raises(Unauthorized) as raised:
        strip_token(wrong)

    assert "eyJ" not in str(raised.value)
    assert "rse-pf token issue" in raised.value.hint


@pytest.mark.system
async def test_a_token_that_was_read_with_its_newline_connects() -> None:
    async with FakePlatform() as platform:
        platform.token = SECRET
        async with robot(platform.url, token=f"{SECRET}\n"):
            assert platform.tokens_seen == [SECRET]


@pytest.mark.system
async def test_a_broken_token_ends_at_once_and_is_in_no_message() -> None:
    async with FakePlatform() as platform:
        with pytest.raises(Unauthorized) as raised:
            await robot(platform.url, token=f"{SECRET}\nX-Other: 1").__aenter__()
        assert "eyJ" not in str(raised.value)
        assert platform.handshakes == []


def test_the_client_of_the_data_service_does_not_show_a_broken_token_either() -> None:
    with pytest.raises(Unauthorized) as raised:
        DataClient("http://127.0.0.1:9", f"{SECRET}\nX-Other: 1").delete("0" * 64)

    assert "eyJ" not in str(raised.value)


@pytest.mark.system
async def test_with_an_offload_a_robot_answers_itself_until_the_cloud_is_there() -> None:
    problem, seen, is_back = make_problem(seed=3), [], asyncio.Event()
    frame = (problem.points_world, problem.pixels, problem.camera)

    def note(what: str, why: str) -> None:
        seen.append(what)
        if what == "link-back":
            is_back.set()

    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        url = f"ws://127.0.0.1:{held.getsockname()[1]}/ws"
        own = robot(url, offload=client_sdk.CloudFirst(), on_change=note)
        async with own:
            answer = await own.solve_pnp(*frame, deadline_s=1.0)

            assert (answer.source, answer.why) == ("robot", "no connection to the cloud")
            np.testing.assert_allclose(answer.solution.T_camera_world, problem.T_camera_world, atol=0.05)
            assert seen == ["link-lost"]
            assert url in own.stats.last_error

            port = held.getsockname()[1]
            held.close()
            platform = FakePlatform()
            await platform.listen(port)
            try:
                await is_back.wait()
                assert (await own.call("echo", {"value": 1}, deadline_s=5)).reply == {"value": 1}
            finally:
                await platform.stop()


@pytest.mark.system
async def test_without_an_offload_a_cloud_that_is_down_is_an_error() -> None:
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        with pytest.raises(ConnectError, match="start the platform by rse-pf local"):
            await robot(f"ws://127.0.0.1:{held.getsockname()[1]}/ws").__aenter__()
