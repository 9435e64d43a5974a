"""Nothing outlives its connection: no timer, no queue, no message of one that is gone."""

from __future__ import annotations

import gc
from collections.abc import Callable

import pytest
from backend.gateway.worker_parts import WorkerParts, quiet_log, worker_parts
from backend.live_map.fake_owners import FakeReader
from backend.rosbridge.clients import Worker, call, rosbridge_worker
from fakes import FakeLoop

from rse_pf.backend.gateway.connection import RobotConnection
from rse_pf.backend.live_map.subscriptions import Subscriptions
from rse_pf.backend.log import JsonLog
from rse_pf.backend.rosbridge.subscription import Subscription, TopicMessage
from rse_pf.wire import Command

TIMES = 20
HOUR_MS = 3_600_000


def held(*kinds: type) -> int:
    """Return how many objects of *kinds* live."""
    gc.collect()
    return sum(isinstance(each, kinds) for each in gc.get_objects())


def use_rosbridge(worker: Worker) -> None:
    client, other = worker.client("r"), worker.client("s")
    for rate, length in ((HOUR_MS, 1), (HOUR_MS, 100), (100, 5), (0, 1)):
        client.say({"op": "subscribe", "topic": f"/t{rate}_{length}", "id": "s", "throttle_rate": rate,
                    "queue_length": length})  # fmt: skip
        for k in range(4):
            message = {"data": f"{k}" * 1000}
            other.say({"op": "publish", "topic": f"/t{rate}_{length}", "msg": message, "latch": k == 2})
    client.wire.unsent = 1 << 20
    client.say({"op": "subscribe", "topic": "/slow", "id": "s"})
    other.say({"op": "publish", "topic": "/slow", "msg": {"data": 1}})
    client.say(call(), {"op": "unsubscribe", "topic": f"/t{HOUR_MS}_1"}, b"\xff")
    client.connection.on_socket_end()
    other.connection.on_socket_end()


def test_a_rosbridge_client_that_left_is_held_by_nothing() -> None:
    with rosbridge_worker() as worker:
        loop = worker.parts.loop
        use_rosbridge(worker)
        loop.advance(1.0)
        kinds = (RobotConnection, Subscription, TopicMessage)
        timers, objects = loop.timers, held(*kinds)
        for _ in range(TIMES):
            use_rosbridge(worker)
        loop.advance(1.0)

        assert loop.timers == timers
        assert held(*kinds) <= objects  # what other tests left may end meanwhile


def test_messages_of_an_ended_subscription_are_held_by_nothing_although_its_client_stays() -> None:
    with rosbridge_worker() as worker:
        client = worker.client("r")
        client.say(call())
        timers, messages = worker.parts.loop.timers, held(TopicMessage)
        for _ in range(TIMES):
            client.say({"op": "subscribe", "topic": "/t", "id": "s", "throttle_rate": HOUR_MS})
            for k in range(4):
                client.say({"op": "publish", "topic": "/t", "msg": {"data": k}})
            client.say({"op": "unsubscribe", "topic": "/t", "id": "s"})

        assert worker.parts.loop.timers == timers
        assert held(TopicMessage) <= messages


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
            connection.on_socket_end()

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
            subscriptions.begin(reader, number, "default", f"m-{number}", may_go_on=lambda: None)
        reader.unsent_bytes = 1 << 20
        loop.advance(0.02)
        subscriptions.update("default", "m-1", "pose/r", {"kind": "pose", "robot": "r", "x": 1.0})
        subscriptions.end(reader, 0)
        loop.advance(0.02)
        subscriptions.left(reader)

    readers = held(FakeReader)
    for _ in range(TIMES):
        cycle()
    loop.advance(1.0)

    assert loop.timers == 0
    assert held(FakeReader) <= readers
    assert (len(subscriptions), watched) == (0, [])
