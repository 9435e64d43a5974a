"""How many sockets one round of the event loop reads, and in which order."""

from __future__ import annotations

import asyncio
import socket
from collections import Counter
from collections.abc import Callable
from functools import partial

import uvloop

from rse_pf.server.scheduling.socket_poller import SocketPoller

SOCKETS = 200
CLOCK_STEP_S = 0.00075
"""What the clock shows more at each look."""


def run_scenario(
    scenario: Callable[[SocketPoller, list[socket.socket], list[socket.socket]], asyncio.Future[None]],
) -> None:
    """Run *scenario* with a poller, sockets that are readable, and their other ends."""
    now = 0.0
    failures: list[object] = []

    def clock() -> float:
        nonlocal now
        now += CLOCK_STEP_S
        return now

    async def run() -> None:
        pairs = [socket.socketpair() for _ in range(SOCKETS)]
        for ours, theirs in pairs:
            ours.setblocking(False)
            theirs.send(b"frame")
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: failures.append(context))
        poller = SocketPoller(loop, clock=clock)
        try:
            await asyncio.wait_for(scenario(poller, [a for a, _ in pairs], [b for _, b in pairs]), 10.0)
        finally:
            for pair in pairs:
                for end in pair:
                    poller.remove_reader(end.fileno())
                    end.close()

    uvloop.run(run())
    assert failures == []


def test_a_round_ends_though_more_sockets_are_readable_and_all_get_their_turn():
    read: list[int] = []
    unread: set[bool] = set()
    in_each_round: list[int] = []

    def scenario(poller, ours, _):
        loop = asyncio.get_running_loop()
        done = loop.create_future()

        def count() -> None:
            unread.add(poller.leaves_unread())
            in_each_round.append(len(read) - sum(in_each_round))
            if len(read) < 4 * SOCKETS:
                loop.call_later(0.0, count)
            else:
                done.set_result(None)

        for end in ours:  # nobody takes what has come, so each stays readable
            poller.add_reader(end.fileno(), partial(read.append, end.fileno()))
        loop.call_soon(count)
        return done

    run_scenario(scenario)

    assert 30 <= max(in_each_round) <= 2 * 40, (
        "the clock lets a round read 40, and two may pass between looks"
    )
    assert True in unread
    times = Counter(read)
    assert len(times) == SOCKETS
    assert max(times.values()) - min(times.values()) <= 2, "those that were just read come last"


def test_nothing_is_left_unread_once_there_was_time_for_all():
    def scenario(poller, ours, theirs):
        loop = asyncio.get_running_loop()
        done = loop.create_future()

        def on_readable(end: socket.socket) -> None:
            left.discard(end)
            end.recv(100)

        def look() -> None:
            unread.append(poller.leaves_unread())
            if left or poller.leaves_unread():
                loop.call_later(0.0, look)
            else:
                done.set_result(None)

        left = set(ours)
        for end in ours:
            poller.add_reader(end.fileno(), partial(on_readable, end))
        loop.call_soon(look)
        return done

    unread: list[bool] = []
    run_scenario(scenario)

    assert True in unread
    assert unread[-1] is False


def test_a_socket_that_another_one_ended_is_not_read():
    read: list[int] = []

    def scenario(poller, ours, _):
        done = asyncio.get_running_loop().create_future()

        def on_readable(end: socket.socket) -> None:
            read.append(end.fileno())
            for other in ours:
                if other is not end:
                    poller.remove_reader(other.fileno())
            end.recv(100)
            if not done.done():
                done.set_result(None)

        for end in ours:
            poller.add_reader(end.fileno(), lambda end=end: on_readable(end))
        return done

    run_scenario(scenario)

    assert len(read) == 1


def test_a_turn_that_ends_early_is_followed_by_others():
    order: list[int] = []

    def scenario(poller, ours, _):
        done = asyncio.get_running_loop().create_future()

        def on_readable(number: int) -> None:
            order.append(number)
            poller.remove_reader(ours[number].fileno())
            if len(order) < 3 * SOCKETS:
                poller.end_turn(lambda: poller.add_reader(ours[number].fileno(), lambda: on_readable(number)))
            elif not done.done():
                done.set_result(None)

        for number, end in enumerate(ours):
            poller.add_reader(end.fileno(), lambda number=number: on_readable(number))
        return done

    run_scenario(scenario)

    times = Counter(order[: 2 * SOCKETS])
    assert len(times) == SOCKETS
    assert set(times.values()) == {2}


def test_what_is_not_reading_is_the_loops():
    def scenario(poller, ours, theirs):
        done = asyncio.get_running_loop().create_future()
        assert poller.remove_reader(ours[0].fileno()) is False
        assert poller.create_future().done() is False
        poller.add_writer(
            theirs[0].fileno(), lambda: (poller.remove_writer(theirs[0].fileno()), done.set_result(None))
        )
        return done

    run_scenario(scenario)
