"""`FakeLoop` does what asyncio's loop does, in the same order."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from fakes import FakeLoop

Run = Callable[[Callable[[], object]], None]
"""Runs a loop until a condition is true."""


def run_real(loop: asyncio.AbstractEventLoop, condition: Callable[[], object]) -> None:
    async def wait() -> None:
        async with asyncio.timeout(10.0):
            while not condition():
                await asyncio.sleep(0.001)  # looks again, with a deadline

    loop.run_until_complete(wait())


def run_fake(loop: FakeLoop, condition: Callable[[], object]) -> None:
    for _ in range(2000):
        if condition():
            return
        loop.advance(0.001)
    loop.run_until(condition)


@pytest.fixture(params=["asyncio", "fake"])
def loop_and_run(request: pytest.FixtureRequest) -> Iterator[tuple[Any, Run]]:
    if request.param == "fake":
        fake = FakeLoop()
        yield fake, lambda condition: run_fake(fake, condition)
        return
    loop = asyncio.new_event_loop()
    yield loop, lambda condition: run_real(loop, condition)
    loop.run_until_complete(loop.shutdown_default_executor())
    loop.close()


def test_timers_come_in_the_order_of_their_time_with_their_arguments(loop_and_run: tuple[Any, Run]) -> None:
    loop, run = loop_and_run
    heard: list[object] = []
    start = loop.time()

    loop.call_later(0.03, heard.append, "late")
    loop.call_later(0.01, heard.append, "early")
    loop.call_later(0.0, heard.append, "now")
    loop.call_soon(heard.append, "soon")
    cancelled = loop.call_later(0.02, heard.append, "cancelled")
    cancelled.cancel()
    run(lambda: "late" in heard)

    assert heard == ["soon", "now", "early", "late"] or heard == ["now", "soon", "early", "late"]
    assert cancelled.cancelled()
    assert loop.time() >= start + 0.03


def test_a_callback_that_a_callback_asks_for_waits_for_the_next_round(loop_and_run: tuple[Any, Run]) -> None:
    loop, run = loop_and_run
    heard: list[str] = []

    def first() -> None:
        heard.append("first")
        loop.call_soon(heard.append, "third")
        loop.call_later(0.0, heard.append, "timer")

    loop.call_soon(first)
    loop.call_soon(heard.append, "second")
    run(lambda: len(heard) == 4)

    assert heard[:2] == ["first", "second"]
    assert sorted(heard[2:]) == ["third", "timer"]


def test_a_call_that_was_cancelled_by_an_earlier_one_of_its_round_does_not_happen(
    loop_and_run: tuple[Any, Run],
) -> None:
    loop, run = loop_and_run
    heard: list[str] = []
    loop.call_soon(lambda: later.cancel())
    later = loop.call_soon(heard.append, "cancelled")
    loop.call_soon(heard.append, "last")
    run(lambda: heard)

    assert heard == ["last"]


def test_threads_are_heard_in_the_thread_of_the_loop(loop_and_run: tuple[Any, Run]) -> None:
    loop, run = loop_and_run
    heard: list[tuple[int, threading.Thread]] = []

    def hear(number: int) -> None:
        heard.append((number, threading.current_thread()))

    def tell() -> None:
        for number in range(3):
            loop.call_soon_threadsafe(hear, number)

    thread = threading.Thread(target=tell)
    thread.start()
    run(lambda: len(heard) == 3)
    thread.join()

    assert heard == [(number, threading.current_thread()) for number in range(3)]


def test_a_future_of_the_executor_tells_its_result_or_its_error(loop_and_run: tuple[Any, Run]) -> None:
    loop, run = loop_and_run
    done: list[Any] = []

    def fail() -> None:
        raise KeyError("no")

    good, bad = loop.run_in_executor(None, divmod, 7, 2), loop.run_in_executor(None, fail)
    good.add_done_callback(done.append)
    bad.add_done_callback(done.append)
    assert done == []
    run(lambda: len(done) == 2)
    good.add_done_callback(done.append)
    assert len(done) == 2, "a callback of a future that is done waits for a round, too"
    run(lambda: len(done) == 3)

    assert good.result() == (3, 1)
    assert isinstance(bad.exception(), KeyError)


def test_descriptors_are_watched_until_they_are_no_longer(loop_and_run: tuple[Any, Run]) -> None:
    loop, run = loop_and_run
    reading, writing = os.pipe()
    heard: list[str] = []
    try:
        loop.add_writer(writing, heard.append, "writable")
        loop.add_reader(reading, heard.append, "readable")
        run(lambda: len(heard) > 2)
        assert set(heard) == {"writable"}
        assert loop.remove_writer(writing)
        assert not loop.remove_writer(writing)

        os.write(writing, b"x")
        heard.clear()
        run(lambda: len(heard) > 2)
        assert set(heard) == {"readable"}, "it is called as long as there is something to read"

        os.read(reading, 1)
        os.close(writing)
        writing = -1
        heard.clear()
        run(lambda: heard)
        assert set(heard) == {"readable"}, "the end of a pipe can be read"
        assert loop.remove_reader(reading)
    finally:
        os.close(reading)
        if writing >= 0:
            os.close(writing)
