"""User functions that raise, block or fork: the failure is reported, and the robot goes on."""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time

import pytest

import client_sdk
from client_sdk.concurrency import user_callbacks
from rse_pf.errors import ConnectError, Disconnected
from rse_pf.wire import Progress
from tests.kit.fakes import FakeServer, answer_at_once, answer_nothing
from tests.kit.quick_robots import QUICK, TIMINGS, robot
from tests.kit.server_thread import server_thread


def raise_error(*_):
    raise KeyError("a bug of the program")


def raise_cancelled(*_):
    raise asyncio.CancelledError


async def is_async(*_):
    raise AssertionError("never awaited")


def raise_without_text(*_):
    class Wordless(Exception):
        def __str__(self):
            raise KeyError("no text")

    raise Wordless


def tracebacks(caplog):
    """Return the exceptions that were logged with their traceback."""
    return [record.exc_info[1] for record in caplog.records if record.exc_info]


@pytest.mark.parametrize("function", [raise_error, raise_cancelled, is_async])
async def test_on_change_that_fails_is_reported_and_the_robot_reconnects(function, caplog):
    async with FakeServer().running() as server, robot(server.url, on_change=function) as a_robot:
        server.cut()

        assert (await a_robot.call("echo", {"value": 2}, deadline_s=20)).reply == {"value": 2}

        stats = a_robot.stats
    assert (stats.callback_errors, stats.reconnects) == (2, 1)
    assert len(tracebacks(caplog)) == 1
    assert "on_change raised" in caplog.text


async def test_on_progress_that_raises_costs_neither_the_connection_nor_the_answer(caplog):
    async def report(fake_robot, command):
        for done in (0.25, 0.5):
            message = Progress(id=command.id, done=done, what="half")
            await fake_robot.websocket.send(fake_robot.session.codec.encode(message))
        await fake_robot.send([])
        answer = answer_at_once(server, fake_robot, command)
        await fake_robot.websocket.send(fake_robot.session.codec.encode(answer))

    def answer(server, fake_robot, command):
        server.extra = asyncio.ensure_future(report(fake_robot, command))

    async with FakeServer(answer=answer).running() as server, robot(server.url) as a_robot:
        ended = await a_robot.call("echo", {"value": 5}, on_progress=raise_error)

        assert ended.reply == {"value": 5}
        assert (a_robot.stats.callback_errors, a_robot.stats.reconnects) == (2, 0)
    assert len(server.all_commands) == len(tracebacks(caplog)) == 1


async def test_on_end_of_a_posted_command_may_raise():
    async with FakeServer().running() as server, robot(server.url) as a_robot:
        a_robot.post("echo", {"value": 1}, raise_error)

        assert (await a_robot.call("echo", {"value": 2})).reply == {"value": 2}
        assert a_robot.stats.callback_errors == 1


@pytest.mark.parametrize("is_blocking", [False, True])
@pytest.mark.parametrize("error", [KeyError("no key"), asyncio.CancelledError(), None])
def test_a_token_callable_that_fails_is_asked_again(error, is_blocking, caplog):
    asked = []

    async def token():
        asked.append(len(asked))
        if len(asked) in (2, 3):
            if error is not None:
                raise error
            asyncio.current_task().cancel()
            await asyncio.sleep(0)
        return f"t{len(asked)}"

    async def drive(url, cut):
        async with robot(url, token=token) as a_robot:
            cut()
            await a_robot.call("echo", {"value": 1}, deadline_s=20)
            return a_robot.stats

    with server_thread() as served:
        if is_blocking:
            connecting = client_sdk.connect_blocking(served.url, token=token, settings=QUICK, timings=TIMINGS)
            with connecting as a_robot:
                served.cut()
                a_robot.call("echo", {"value": 1}, deadline_s=20)
                stats = a_robot.stats
        else:
            stats = asyncio.run(drive(served.url, served.cut))
        assert served.server.tokens == ["Bearer t1", "Bearer t4"]
    assert (stats.callback_errors, stats.reconnects) == (2, 1)
    assert len(tracebacks(caplog)) in (1, 2)  # a cancellation may be raised in two lines of asyncio


@pytest.mark.parametrize("has_filter", [False, True])
@pytest.mark.parametrize("function", [raise_error, raise_without_text])
def test_callables_of_a_blocking_robot_are_called_after_one_whose_report_fails(function, has_filter):
    changes, logger, is_over = [], logging.getLogger("client_sdk"), threading.Event()

    def change(what, why):
        changes.append(what)
        if len(changes) == 1:
            function()
        is_over.set()

    if has_filter:
        logger.addFilter(raise_error)
    try:
        with server_thread() as served:
            connecting = client_sdk.connect_blocking(
                served.url, on_change=change, settings=QUICK, timings=TIMINGS
            )
            with connecting:
                served.cut()
                assert is_over.wait(10)
    finally:
        logger.removeFilter(raise_error)


async def test_a_callable_that_blocks_asyncio_is_reported(caplog):
    blocked = []

    def block(change, why):
        if not blocked:
            blocked.append(change)
            until = time.monotonic() + 3 * QUICK.ping_timeout_s
            threading.Event().wait(until - time.monotonic())

    async with FakeServer().running() as server, robot(server.url, on_change=block) as a_robot:
        server.cut()

        assert (await a_robot.call("echo", {"value": 2}, deadline_s=20)).reply == {"value": 2}
        assert a_robot.stats.callback_errors == 1
    assert "on_change took 1." in caplog.text


async def test_a_token_callable_that_only_awaits_is_not_reported_as_slow(caplog):
    async def token():
        await asyncio.sleep(1.5 * QUICK.ping_timeout_s)
        return "t1"

    async with FakeServer().running() as server, robot(server.url, token=token) as a_robot:
        assert a_robot.stats.callback_errors == 0
    assert "took" not in caplog.text


@pytest.mark.parametrize("has_thread", [False, True])
async def test_a_token_callable_that_hangs_is_reported_as_late(has_thread, monkeypatch, caplog):
    monkeypatch.setattr(user_callbacks, "TOKEN_TIMEOUT_S", 0.1)
    calling = user_callbacks.UserCallbacks()
    if has_thread:
        calling.start_thread()

    with pytest.raises(ConnectError, match="TimeoutError"):
        await calling.fetch_token(asyncio.Event().wait)
    assert "no token within 0.1 s" in caplog.text
    calling.end_thread()


async def test_token_callables_of_a_blocking_robot_share_a_loop_until_one_hangs(monkeypatch):
    monkeypatch.setattr(user_callbacks, "TOKEN_TIMEOUT_S", 0.5)
    calling, may_go_on, seen = user_callbacks.UserCallbacks(), threading.Event(), []
    calling.start_thread()

    async def token():
        seen.append((asyncio.get_running_loop(), threading.current_thread()))
        if len(seen) == 3:
            may_go_on.wait(10)
        return "t"

    for is_late in (False, False, True, False):
        if is_late:
            with pytest.raises(ConnectError):
                await calling.fetch_token(token)
        else:
            assert await calling.fetch_token(token) == "t"
    may_go_on.set()
    calling.end_thread()
    assert seen[0] == seen[1] == seen[2] != seen[3]
    for _, thread in seen:
        await asyncio.to_thread(thread.join, 10)
        assert not thread.is_alive()


async def test_a_callable_outside_the_event_loop_is_not_reported_as_slow(caplog):
    calling = user_callbacks.UserCallbacks(slow_s=-1.0)

    await asyncio.to_thread(calling.call, "progress", int)
    assert calling.errors == 0
    calling.call("progress", int)
    assert calling.errors == 1


def test_a_callable_of_a_blocking_robot_may_block_without_cost_to_the_connection():
    begun, may_end = threading.Event(), threading.Event()

    def block(change, why):
        begun.set()
        may_end.wait(60)

    with server_thread() as served:
        robot = client_sdk.connect_blocking(served.url, on_change=block, settings=QUICK, timings=TIMINGS)
        with robot:
            served.cut()
            assert begun.wait(20)
            until = time.monotonic() + 3 * QUICK.ping_timeout_s
            while time.monotonic() < until:
                assert robot.call("echo", {"value": 1}, deadline_s=20).reply == {"value": 1}
            assert robot.stats.reconnects == 1
            may_end.set()


def test_a_callable_of_a_blocking_robot_may_use_and_close_its_own_robot():
    replies, closed = [], threading.Event()

    def change(what, why):
        if what == "link-back":
            replies.append((robot.stats.reconnects, robot.call("echo", {"value": 3}, deadline_s=20).reply))
            robot.close()
            robot.close()
            closed.set()

    with server_thread() as served:
        robot = client_sdk.connect_blocking(served.url, on_change=change, settings=QUICK, timings=TIMINGS)
        with robot:
            served.cut()
            assert closed.wait(20)
            with pytest.raises(Disconnected):
                robot.call("echo", {"value": 4})
            assert robot.stats.callback_errors == 0
    assert replies == [(1, {"value": 3})]
    assert [command.payload for command in served.server.all_commands] == [{"value": 3}]


async def test_a_call_that_its_own_callable_cancels_ends_and_is_not_sent_again():
    async with FakeServer(answer=answer_nothing).running() as server:
        calls = []

        def cancel(change, why):
            for call in calls:
                call.cancel()

        async with robot(server.url, on_change=cancel) as a_robot:
            calls.append(asyncio.ensure_future(a_robot.call("echo", {"value": 1}, deadline_s=20)))
            await server.until(lambda: len(server.all_commands) == 1)
            server.cut()
            with pytest.raises(asyncio.CancelledError):
                await calls[0]
            server.answer = answer_at_once
            assert (await a_robot.call("echo", {"value": 2}, deadline_s=20)).reply == {"value": 2}
    assert [command.payload for command in server.all_commands] == [{"value": 1}, {"value": 2}]


async def test_a_robot_closed_in_a_child_of_a_fork_stays_connected_in_the_parent():
    async with FakeServer().running() as server, robot(server.url) as a_robot:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                a_robot.close().send(None)
            except StopIteration:
                status = 0
            finally:
                os._exit(status)
        _, status = await asyncio.to_thread(os.waitpid, child, 0)

        assert os.waitstatus_to_exitcode(status) == 0
        assert (await a_robot.call("echo", {"value": 2})).reply == {"value": 2}
        assert a_robot.stats.reconnects == 0


def test_the_child_of_a_callable_that_forks_does_not_go_on_as_the_robot(caplog):
    children = []

    def fork(change, why):
        if not children:
            children.append(os.fork())

    async def drive(served):
        async with robot(served.url, on_change=fork) as a_robot:
            served.cut()
            reply = (await a_robot.call("echo", {"value": 2}, deadline_s=20)).reply
            return reply, await asyncio.to_thread(os.waitpid, children[0], 0)

    with server_thread() as served:
        reply, (_, status) = asyncio.run(drive(served))

    assert reply == {"value": 2}
    assert os.waitstatus_to_exitcode(status) == 1
    assert len(served.server.all_commands) == 1
