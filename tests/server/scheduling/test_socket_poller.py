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
