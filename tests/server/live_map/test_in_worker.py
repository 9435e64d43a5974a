"""Subscriptions and commands to live maps on their way through a worker."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from rse_pf.server.gateway.answers import Answers
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.live_map.router import LiveMapRouter
from rse_pf.server.worker_context import WorkerContext
from rse_pf.wire import Command, Failure, Hello, Subscribe, Unsubscribe, Update
from rse_pf.wire.server_session import MAX_SUBSCRIPTIONS
from tests.kit.fake_map_client import FakeLiveMapClient
from tests.kit.worker_parts import BINARY, WorkerParts, worker_parts

HELLO = Hello(capabilities=("updates",))


class Worker(WorkerParts):
    """A worker with live maps, whose map servers are fake."""

    client: FakeLiveMapClient

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, live_maps=self._router, **more)

    def _router(self, context: WorkerContext, answers: Answers) -> LiveMapRouter:
        def make_client(on_update: Any) -> FakeLiveMapClient:
            self.client = FakeLiveMapClient(on_update)
            return self.client

        return LiveMapRouter(context, make_client=make_client, answer=answers.send_message)

    def tell(self, keyframes: int) -> None:
        self.client.on_update("default", "m", {"kind": "map", "keyframes": keyframes})
        self.loop.advance(0.1)

    def subscriber(self, name: str = "r") -> tuple[RobotConnection, Any]:
        connection, wire = self.join(name, hello=False)
        self.say(connection, HELLO)
        wire.sent.clear()
        return connection, wire


@pytest.fixture
def worker(monkeypatch: pytest.MonkeyPatch) -> Iterator[Worker]:
    monkeypatch.setattr("tests.kit.worker_parts.WorkerParts", Worker)
    with worker_parts() as parts:
        assert isinstance(parts, Worker)
        yield parts


def keyframes(wire: Any) -> list[int]:
    return [message.payload["keyframes"] for message in wire.sent if isinstance(message, Update)]


def test_a_robot_without_the_capability_is_refused_and_sees_nothing_new(worker: Worker) -> None:
    connection, wire = worker.join()
    wire.sent.clear()

    worker.say(connection, Subscribe(id=4, topic="live/m"))
    worker.tell(1)

    [failure] = wire.sent
    assert (failure.id, failure.code) == (4, "bad-request")
    assert worker.client.watched == []


def test_a_ninth_subscription_is_above_the_quota_until_one_ends(worker: Worker) -> None:
    connection, wire = worker.subscriber()
    for number in range(MAX_SUBSCRIPTIONS + 1):
        worker.say(connection, Subscribe(id=number, topic=f"live/m{number}"))
    assert [(message.id, message.code) for message in wire.sent if isinstance(message, Failure)] == [
        (8, "quota")
    ]

    worker.say(connection, Unsubscribe(id=0))
    worker.say(connection, Subscribe(id=8, topic="live/m8"))

    assert [name for _, name in worker.client.watched] == [f"m{number}" for number in range(9)]
    assert worker.client.unwatched == [("default", "m0")]


def test_without_live_maps_topics_and_services_are_unknown() -> None:
    with worker_parts() as parts:
        connection, wire = parts.join(hello=False)
        parts.say(connection, HELLO)
        wire.sent.clear()

        parts.say(connection, Subscribe(id=4, topic="live/m"))
        parts.say(connection, Command(id=5, service="live-keyframe", payload={}))

        assert [(message.id, message.code) for message in wire.sent] == [
            (4, "not-found"),
            (5, "unknown-service"),
        ]


def test_a_subscription_before_hello_closes_the_connection(worker: Worker) -> None:
    connection, wire = worker.join(hello=False)

    connection.receive_frame(BINARY, True, False, worker.codec.encode(Subscribe(id=1, topic="live/m")))

    assert wire.closed is not None
    assert wire.closed[0] == 4400
