"""A cheap command of an idle server takes the shortest way, and no one can tell but by what it costs."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from rse_pf.auth.tokens import Claims
from rse_pf.config import PlatformSettings
from rse_pf.errors import TooFewCorrespondences
from rse_pf.identity import RobotId
from rse_pf.server.gateway.service_queues import StatelessQueue
from rse_pf.server.scheduling.scheduler import INLINE_BYTES
from rse_pf.service import Registry
from rse_pf.storage.object_store import MemoryStore
from rse_pf.wire import Command
from tests.kit.worker_parts import WorkerParts, worker_parts

SETTINGS = PlatformSettings.from_dict({"session": {"max_message_bytes": 65536}})


class Anything(msgspec.Struct, frozen=True, kw_only=True):
    value: Any = None


class Stored(msgspec.Struct, frozen=True, kw_only=True):
    data: bytes = b""


def register(registry: Registry) -> None:
    @registry.service("refuses", cheap=True)
    def refuses(request: Anything) -> Anything:
        raise TooFewCorrespondences("got 1", hint="send more")

    @registry.service("fails", cheap=True)
    def fails(request: Anything) -> Anything:
        raise RuntimeError("a defect")

    @registry.service("odd", cheap=True)
    def odd(request: Anything) -> Anything:
        return Anything(value=object())

    @registry.service("large", cheap=True)
    def large(request: Anything) -> Anything:
        return Anything(value=bytes(1 << 17))

    @registry.service("takes-objects", cheap=True)
    def takes_objects(request: Stored) -> Stored:
        return request


COMMANDS = [
    {"service": "echo", "payload": {"value": 1}},
    {"service": "echo", "payload": {"value": "x"}, "deadline_ms": 0.0},
    {"service": "echo", "payload": {"value": [1, [2, {"three": 4}]]}, "stream": "s", "seq": 4, "trace": "t"},
    {"service": "echo", "payload": {"value": "y" * INLINE_BYTES}},
    {"service": "echo", "payload": 3},
    {"service": "refuses", "payload": {}},
    {"service": "fails", "payload": None},
    {"service": "odd", "payload": {}},
    {"service": "large", "payload": {}},
    {"service": "takes-objects", "payload": {"data": b"here"}},
    {"service": "takes-objects", "payload": {"data": {"object": "0" * 64}}},
    {"service": "absent", "payload": {}},
]


def play(worker: WorkerParts, claims: Claims | None) -> tuple[Any, ...]:
    """Return what the robot heard, and what the worker counted and knows afterwards."""
    connection, wire = worker.join()
    connection.claims = claims
    for number, command in enumerate(COMMANDS, 1):
        worker.loop.now += 0.5
        worker.say(connection, Command(id=number, **command))
        worker.loop.run_until(lambda answers=number: len(wire.sent) > answers)  # type: ignore[misc]
        worker.loop.turn()
    told = [
        msgspec.structs.replace(message, received_s=0.0, sent_s=0.0)
        if hasattr(message, "received_s")
        else message
        for message in wire.sent[1:]
    ]
    counts = worker.scheduler.waiting, worker.scheduler.running
    return told, worker.dispatcher.snapshot(), counts, connection.allowed_s, worker.dispatcher.held


@pytest.mark.parametrize(
    ("scopes", "has_store", "emulated_cores"),
    [
        (None, False, 0.0),
        (None, True, 0.0),
        (None, False, 1.0),
        ((), True, 0.0),
        (("services:odd", "services:echo"), False, 0.0),
        (("services:*",), True, 0.0),
    ],
)
def test_the_shortest_way_answers_and_counts_as_the_queue_does(
    monkeypatch: pytest.MonkeyPatch,
    scopes: tuple[str, ...] | None,
    has_store: bool,
    emulated_cores: float,
) -> None:
    claims = None
    if scopes is not None:
        claims = Claims(
            robot=RobotId("default", "r"),
            token_id="t",
            issued_s=0.0,
            expires_s=2e6,
            key_id="k",
            scopes=scopes,
        )

    def outcome() -> tuple[Any, ...]:
        store = MemoryStore() if has_store else None
        with worker_parts(
            settings=SETTINGS, register=register, store=store, emulated_cores=emulated_cores
        ) as worker:
            return play(worker, claims)

    shortest = outcome()
    monkeypatch.setattr(StatelessQueue, "runs_at_once", lambda self, queued: False)
    queued = outcome()

    assert shortest == queued
    assert len(shortest[0]) == len(COMMANDS)
