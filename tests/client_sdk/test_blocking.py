"""The blocking twin has the same methods and no rules of its own."""

from __future__ import annotations

import asyncio
import inspect
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from fakes import FakeServer

import client_sdk
from rse_pf.errors import Disconnected, UnknownService


@pytest.fixture
def url():
    started = threading.Event()
    stop: list[asyncio.Event] = []
    found: list[str] = []
    loop = asyncio.new_event_loop()

    async def serve() -> None:
        stop.append(asyncio.Event())
        async with FakeServer().running() as server:
            found.append(server.url)
            started.set()
            await stop[0].wait()

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),))
    thread.start()
    assert started.wait(10)
    yield found[0]
    loop.call_soon_threadsafe(stop[0].set)
    thread.join(10)
    loop.close()


def test_has_the_public_methods_of_the_robot():
    def public(kind: type) -> set[str]:
        return {name for name in vars(kind) if not name.startswith("_")}

    for_loops_only = {"post"}  # its callback would come in the robot's thread
    assert public(client_sdk.BlockingRobot) == public(client_sdk.Robot) - for_loops_only


@pytest.mark.parametrize("method", ["call", "solve_pnp", "store_object", "close"])
def test_takes_the_same_arguments_as_the_robot(method):
    ours, theirs = (getattr(kind, method) for kind in (client_sdk.BlockingRobot, client_sdk.Robot))

    assert inspect.signature(ours).parameters == inspect.signature(theirs).parameters


def test_connects_with_the_same_arguments_as_the_robot():
    ours, theirs = client_sdk.connect_blocking, client_sdk.connect

    assert inspect.signature(ours).parameters == inspect.signature(theirs).parameters


def test_a_closed_robot_is_disconnected_and_may_be_closed_again(url):
    with client_sdk.connect_blocking(url) as robot:
        robot.close()
        with pytest.raises(Disconnected):
            robot.call("echo", {})
    assert robot.stats.sent == 0


def test_many_threads_share_one_robot(url):
    with client_sdk.connect_blocking(url) as robot, ThreadPoolExecutor(6) as threads:
        values = threads.map(lambda n: robot.call("echo", {"value": n}).reply["value"], range(60))

        assert list(values) == list(range(60))


def test_calls_and_raises_like_the_robot(url):
    with client_sdk.connect_blocking(url) as robot:
        assert robot.call("echo", {"value": 4}).reply == {"value": 4}
        with pytest.raises(UnknownService):
            robot.call("nothing", {})
        assert robot.stats.answered == 1


def test_leaves_no_thread_behind(url):
    with client_sdk.connect_blocking(url) as robot:
        robot.call("echo", {})
    assert not [thread for thread in threading.enumerate() if thread.name == "rse-pf-robot"]
