"""Nothing outlives its connection: no timer, no queue, no message of one that is gone."""

from __future__ import annotations

import gc
from collections.abc import Callable

import pytest

from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.live_map.subscriptions import Subscriptions
from rse_pf.server.log import JsonLog
from rse_pf.wire import Command
from tests.kit.fake_map_client import FakeReader
from tests.kit.fakes import FakeLoop
from tests.kit.worker_parts import WorkerParts, quiet_log, worker_parts

TIMES = 20


def held(*kinds: type) -> int:
    """Return how many objects of *kinds* live."""
    gc.collect()
    return sum(isinstance(each, kinds) for each in gc.get_objects())


def leave_silently(parts: WorkerParts, connection: RobotConnection) -> None:
    parts.say(connection, Command(id=1, service="echo", payload="x"))
    parts.loop.advance(0.05)


def leave_while_a_command_waits(parts: WorkerParts, connection: RobotConnection) -> None:
    for k in range(5):
        parts.say(connection, Command(id=k + 1, service="echo", payload=k, keep=True))


def leave_while_it_is_replaced(parts: WorkerParts, connection: RobotConnection) -> None:
    connection.move("rebalance", 600_000.0, parts.loop.now)
    parts.token_watch.replace(connection.number)


@pytest.mark.parametrize("leave", [leave_silently, leave_while_a_command_waits, leave_while_it_is_replaced])
def test_a_robot_that_left_is_held_by_nothing(leave: Callable[[WorkerParts, RobotConnection], None]) -> None:
    with worker_parts() as parts:

        def cycle() -> None:
            connection, _ = parts.join("r", expires_s=2e6)
            leave(parts, connection)
            parts.dispatcher.disconnect(connection)

        cycle()
        parts.loop.advance(1.0)
        timers, connections = parts.loop.timers, held(RobotConnection)
        for _ in range(TIMES):
            cycle()
        parts.loop.advance(1.0)

        assert parts.loop.timers == timers
        assert held(RobotConnection) <= connections


def test_a_reader_of_a_live_map_that_left_is_held_by_nothing() -> None:
    with quiet_log() as log:
        _watch_and_leave(log)


def _watch_and_leave(quiet: JsonLog) -> None:
    loop = FakeLoop()
    watched: list[tuple[str, str]] = []
    subscriptions = Subscriptions(
        loop=loop,  # type: ignore[arg-type]
        log=quiet,
        watch=lambda tenant, map_name, _: watched.append((tenant, map_name)),
        unwatch=lambda *key: watched.remove(key),
    )

    def cycle() -> None:
        reader = FakeReader()
        for number in range(4):
            subscriptions.begin(reader, number, "default", f"m-{number}", find_error=lambda: None)
        reader.unsent_bytes = 1 << 20
        loop.advance(0.02)
        subscriptions.update("default", "m-1", "pose/r", {"kind": "pose", "robot": "r", "x": 1.0})
        subscriptions.end(reader, 0)
        loop.advance(0.02)
        subscriptions.end_all(reader)

    readers = held(FakeReader)
    for _ in range(TIMES):
        cycle()
    loop.advance(1.0)

    assert loop.timers == 0
    assert held(FakeReader) <= readers
    assert (len(subscriptions), watched) == (0, [])
