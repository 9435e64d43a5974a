"""The queue of limited services in a worker: it has turns and deadlines of its own."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import msgspec
import pytest
from server.compute.test_limited_services import ScriptedProcesses, reply_of

from rse_pf.errors import Crashed
from rse_pf.service import Registry
from rse_pf.wire import Command, Failure, Result
from tests.kit.fakes import FakeWire
from tests.kit.worker_parts import WorkerParts, worker_parts


class Map(msgspec.Struct, frozen=True, kw_only=True):
    map: bytes = b""


def register(registry: Registry) -> None:
    @registry.service("map", limited=True)
    def of_map(request: Map) -> Map:
        raise AssertionError("a limited service ran in the worker")


class HeldProcesses(ScriptedProcesses):
    """Each call waits until the test lets it go; ``robots`` asked, in this order."""

    def __init__(self) -> None:
        super().__init__()
        self.go = threading.Semaphore(0)
        self.robots: list[str] = []

    def call(self, data: bytes, timeout_s: float) -> bytes:
        self.robots.append(msgspec.msgpack.decode(data)[3][1])
        assert self.go.acquire(timeout=10.0)
        return super().call(data, timeout_s)


@pytest.fixture
def processes() -> HeldProcesses:
    return HeldProcesses()


@pytest.fixture
def worker(processes: HeldProcesses) -> Iterator[WorkerParts]:
    with worker_parts(register=register, processes=processes) as parts:
        yield parts
        processes.go.release(100)


def asked(number: int, **more: object) -> Command:
    return Command(id=number, service="map", payload={"map": b"m"}, **more)


def answers(wire: FakeWire) -> list[tuple[int | None, str]]:
    """Return the answers so far: the id, and ``ok`` or the code."""
    return [
        (message.id, "ok" if isinstance(message, Result) else message.code)
        for message in wire.sent
        if isinstance(message, (Result, Failure))
    ]


def test_robots_take_turns(worker: WorkerParts, processes: HeldProcesses):
    processes.script = [reply_of(1.0, None)] * 4
    (one, _), (other, _) = worker.join("one"), worker.join("other")
    for number in (1, 2, 3):
        worker.say(one, asked(number))
    worker.say(other, asked(4))

    processes.go.release(4)
    worker.loop.run_until(lambda: not worker.dispatcher.held)

    assert processes.robots == ["one", "other", "one", "one"]


def test_a_robot_that_is_kept_out_is_answered_at_once_and_solves_on(
    worker: WorkerParts, processes: HeldProcesses
):
    processes.script = [Crashed("memory"), Crashed("memory")]
    processes.go.release(2)
    one, wire = worker.join("one")
    for number in (1, 2):
        worker.say(one, asked(number))
        worker.loop.run_until(lambda number=number: len(answers(wire)) == number)

    worker.say(one, asked(3))
    worker.say(one, Command(id=4, service="echo", payload={"value": 1}))

    assert answers(wire) == [(1, "crashed"), (2, "crashed"), (3, "busy"), (4, "ok")]
    assert worker.metrics.shed["blocked"] == 1
    assert worker.dispatcher.snapshot()["gauges"]["compute_blocked_robots"] == 1.0
