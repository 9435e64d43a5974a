"""The dispatcher of a worker on fake wires and a loop whose time the test moves."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId, object_name
from rse_pf.server.gateway.answers import EncodedAnswer
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.scheduling.command_queue import CommandQueue, QueueBacklog, QueuedCommand, QueueReport
from rse_pf.service import Registry
from rse_pf.storage.object_store import MemoryStore, digest_of
from rse_pf.wire import Command, Failure, Move, Ping, Pong, Result, Welcome
from tests.kit.admitted_commands import measure_turns, queued
from tests.kit.fakes import FakeLoop, FakeWire
from tests.kit.worker_parts import BINARY, WorkerParts, worker_parts

SETTINGS = PlatformSettings()


class Large(msgspec.Struct, frozen=True, kw_only=True):
    data: bytes = b""


class Odd(msgspec.Struct, frozen=True, kw_only=True):
    value: Any = None


def register(registry: Registry) -> None:
    @registry.service("odd", cheap=True)
    def odd(request: Odd) -> Odd:
        return Odd(value=object())

    @registry.service("large", cheap=True)
    def large(request: Large) -> Large:
        return request

    @registry.service("kept", kind="per_robot_state")
    def kept(request: Odd) -> Odd:
        return request

    @registry.service("long", kind="long")
    def long(request: Odd) -> Odd:
        return request


@pytest.fixture
def worker() -> Iterator[WorkerParts]:
    loops: list[FakeLoop] = []

    def register_all(registry: Registry) -> None:
        register(registry)

        @registry.service("half", cheap=True)
        def half(request: Odd) -> Odd:
            loops[0].now += 0.0006
            return request

    with worker_parts(register=register_all) as parts:
        loops.append(parts.loop)
        yield parts


def echo(number: int, **command: Any) -> Command:
    return Command(id=number, service="echo", payload={"value": 1}, **command)


def half(number: int, **command: Any) -> Command:
    """Return a command that takes 0.6 ms."""
    return Command(id=number, service="half", payload={"value": 1}, **command)


def results(wire: FakeWire) -> list[Result]:
    return [message for message in wire.sent if isinstance(message, Result)]


def refused(wire: FakeWire) -> list[int | None]:
    return [message.id for message in wire.sent if isinstance(message, Failure)]


def test_a_named_object_is_read_by_a_thread_and_a_large_reply_is_stored_in_turn():
    store, data, threads = MemoryStore(), bytes(2 * SETTINGS.session.max_message_bytes), set()
    store.put(object_name(RobotId("default", "r"), digest_of(data)), data)
    get = store.get

    def noted_get(name: str) -> bytes:
        threads.add(threading.current_thread().name)
        return get(name)

    store.get = noted_get  # type: ignore[method-assign]
    with worker_parts(register=register, store=store) as worker:
        connection, wire = worker.join()
        worker.say(connection, Command(id=3, service="large", payload={"data": {"object": digest_of(data)}}))
        worker.loop.run_until(lambda: results(wire))

    (result,) = results(wire)
    assert (result.id, result.reply) == (3, None)
    reply = msgspec.msgpack.decode(get(object_name(RobotId("default", "r"), result.object)), type=Large)
    assert reply.data == data
    assert threads == {"solver-0"}, "the event loop never waits for the store"


def test_a_kind_of_service_that_this_server_does_not_run_is_refused(worker: WorkerParts):
    connection, wire = worker.join()

    worker.say(connection, Command(id=3, service="kept", payload={}))

    assert wire.sent[-1].code == "unknown-service"
    assert worker.dispatcher.held == 0


def test_nothing_is_written_behind_a_close(worker: WorkerParts):
    connection, wire = worker.join()
    connection.close(1001, "leaving")

    connection.write(worker.codec.encode(Move(reason="drain", within_ms=1.0)))
    worker.say(connection, Ping(sent_s=1.0))

    assert [type(m) for m in wire.sent] == [Welcome]


def overload(worker: WorkerParts) -> QueuedCommand:
    """Return a command that runs while another one waits, on a server whose turns take half a second."""
    measure_turns(worker.scheduler, 0.5, worker.loop.now)
    for name in ("runs", "waits"):
        worker.scheduler.submit(queued(name, at=worker.loop.now))
    running, _ = worker.scheduler.start(worker.loop.now)
    assert running is not None
    return running


def send_until_refused(worker: WorkerParts, connection: RobotConnection, wire: FakeWire) -> int:
    """Send commands with little time until one is refused; return its number."""
    for number in range(10, 20):
        worker.say(connection, echo(number, deadline_ms=250.0))
        if number in refused(wire):
            return number
    raise AssertionError("none was refused")


def end_overload(worker: WorkerParts, running: QueuedCommand) -> None:
    """End the command that runs, and those that wait for it."""
    worker.scheduler.leave("waits")
    worker.scheduler.done(running, worker.loop.now)


def test_a_robot_that_has_to_pause_is_refused_until_then_while_others_wait(worker: WorkerParts):
    connection, wire = worker.join()
    worker.say(connection, echo(7, deadline_ms=250.0))
    running = overload(worker)
    first = send_until_refused(worker, connection, wire)
    pause_ms = wire.sent[-1].retry_after_ms

    worker.loop.now += 0.3
    worker.say(connection, echo(21, deadline_ms=250.0))
    assert refused(wire) == [first, 21]
    assert wire.sent[-1].retry_after_ms == pytest.approx(pause_ms - 300.0)

    end_overload(worker, running)
    worker.say(connection, echo(22, deadline_ms=250.0))
    assert refused(wire) == [first, 21], "nothing waits any more"
    assert results(wire)[-1].id == 22


def test_a_robot_that_ignores_its_pause_is_read_one_command_at_a_time(worker: WorkerParts):
    connection, wire = worker.join()
    worker.say(connection, echo(7, deadline_ms=250.0))
    running = overload(worker)
    send_until_refused(worker, connection, wire)
    for number in range(30, 39):
        worker.say(connection, echo(number, deadline_ms=250.0))
    assert refused(wire)[-9:] == list(range(30, 39))
    assert wire.holds == 0

    for number in range(40, 43):
        worker.say(connection, echo(number, deadline_ms=250.0))
    assert wire.holds == 1
    assert refused(wire)[-1] == 38, "it is refused no more"
    end_overload(worker, running)
    worker.say(worker.join("next")[0], echo(1))
    worker.loop.run_until(lambda: len(results(wire)) >= 4)

    assert [result.id for result in results(wire)[-3:]] == [40, 41, 42]
    assert wire.holds == 0

    for number in range(50, 53):
        worker.say(connection, echo(number))
        assert wire.holds == 0, "while nothing waits it is served as any other robot"
        assert results(wire)[-1].id == number


def test_nothing_is_lost_while_a_long_command_of_a_robot_that_ignores_pauses_is_decoded(worker: WorkerParts):
    connection, wire = worker.join()
    worker.say(connection, echo(7, deadline_ms=250.0))
    running = overload(worker)
    send_until_refused(worker, connection, wire)
    for number in range(30, 39):
        worker.say(connection, echo(number, deadline_ms=250.0))
    assert refused(wire)[-9:] == list(range(30, 39))

    worker.say(connection, Command(id=40, service="echo", payload={"text": "x" * 20_000}, deadline_ms=60e3))
    worker.say(connection, echo(41, deadline_ms=60e3))
    worker.loop.run_until(lambda: worker.dispatcher.held > 2)
    end_overload(worker, running)
    worker.say(worker.join("next")[0], echo(1))
    worker.loop.run_until(lambda: [result.id for result in results(wire)[-2:]] == [40, 41])

    assert wire.holds == 0


def test_hellos_pings_and_unknown_services_are_decoded_even_behind(worker: WorkerParts):
    overload(worker)
    connection, wire = worker.join()

    worker.say(connection, Ping(sent_s=1.0))
    worker.say(connection, Command(id=3, service="nothing", payload={}))

    assert [type(m) for m in wire.sent] == [Welcome, Pong, Failure]
    assert wire.sent[-1].code == "unknown-service"
    assert worker.metrics.shed["unread"] == 0


def test_a_round_of_the_loop_computes_for_a_millisecond_so_that_the_queue_is_seen(worker: WorkerParts):
    first, _ = worker.join("first")
    for number in range(20):  # until the service is known to be short
        worker.say(first, half(number))
        worker.loop.advance()
    robots = [worker.join(name) for name in "abcdef"]

    for connection, _ in robots:
        worker.say(connection, half(1))

    assert [len(results(wire)) for _, wire in robots] == [1, 1, 0, 0, 0, 0]
    assert worker.dispatcher.held == 4
    worker.loop.turn()
    assert [len(results(wire)) for _, wire in robots] == [1, 1, 1, 1, 0, 0]
    worker.loop.run_until(lambda: worker.dispatcher.held == 0)
    assert [len(results(wire)) for _, wire in robots] == [1] * 6


def test_a_robot_that_sends_undecodable_messages_is_read_more_and_more_rarely(worker: WorkerParts):
    connection, wire = worker.join()

    for _ in range(3):
        connection.receive_frame(BINARY, True, False, b"garbage")

    assert wire.pauses == pytest.approx([0.1, 0.2, 0.3])
    assert [message.code for message in wire.sent[1:]] == ["bad-message"] * 3


def test_a_flood_is_refused_by_id_and_then_cut_off(worker: WorkerParts):
    connection, wire = worker.join()

    for number in range(200):
        worker.say(connection, echo(number))
        worker.loop.advance()
        if wire.closed:
            break

    refused = [each for each in wire.sent if isinstance(each, Failure) and "rate" in each.message]
    assert number == 40 + 120 - 1
    assert [each.id for each in refused] == list(range(40, 159))
    assert all(each.code == "busy" and each.retry_after_ms > 0 for each in refused)
    assert wire.closed == (4429, "rate")
    assert worker.admission.rates.banned_s(connection.robot, worker.loop.now) > 0
    assert worker.metrics.shed["rate"] == 120


class Queue(CommandQueue):
    """Keeps what is submitted, and notes what else it is told."""

    held = 0

    def __init__(self, service: str, waiting: int = 0) -> None:
        self.submitted: list[QueuedCommand] = []
        self.told: list[Any] = []
        self._service = service
        self._waiting = waiting

    def offers(self, service: str) -> bool:
        return service == self._service

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        return QueueBacklog(self._waiting)

    def submit(self, queued: QueuedCommand, now: float) -> None:
        self.submitted.append(queued)

    def withdraw(self, owner: Any, command_id: int) -> None:
        self.told.append(("withdraw", owner, command_id))

    def enter(self, owner: Any) -> None:
        self.told.append(("enter", owner))

    def leave(self, owner: Any) -> list[QueuedCommand]:
        self.told.append(("leave", owner))
        return [queued for queued in self.submitted if queued.owner is owner]

    def report(self) -> QueueReport:
        return QueueReport(gauges={self._service: 1.0}, cpu_s={self._service: {"acme": 2.0}})

    def give_up(self) -> None:
        self.told.append("give-up")

    def close(self) -> None:
        self.told.append("close")


@pytest.mark.parametrize("service", ["installed", "long", "echo"])
@pytest.mark.parametrize(
    ("deadline_ms", "waiting", "code"), [(1000.0, 0, ""), (0.0, 0, "expired"), (1000.0, 8, "busy")]
)
def test_every_kind_of_command_passes_the_same_admission(
    service: str, deadline_ms: float, waiting: int, code: str
):
    sandboxes, jobs = Queue("installed", waiting), Queue("long", waiting)
    with worker_parts(register=register, queues=[sandboxes, jobs]) as worker:
        connection, wire = worker.join()
        if service == "echo":
            for number in range(waiting):
                worker.scheduler.submit(queued("r", number, at=worker.loop.now))

        payload = {"value": 1}
        worker.say(connection, Command(id=1, service=service, payload=payload, deadline_ms=deadline_ms))

        refusals = [message.code for message in wire.sent if isinstance(message, Failure)]
        assert refusals == ([code] if code else [])
        taken = {"installed": sandboxes.submitted, "long": jobs.submitted, "echo": results(wire)}
        assert {name for name, commands in taken.items() if commands} == ({service} if not code else set())


@pytest.mark.parametrize(
    ("since_s", "leaves_unread", "computed"),
    [(0.0005, False, 2), (0.0039, False, 3), (1.0, False, 6), (1.0, True, 2)],
)
def test_a_round_computes_for_as_long_as_it_may(since_s: float, leaves_unread: bool, computed: int):
    with worker_parts() as worker:
        asked = [worker.join(f"r{number}") for number in range(20)]
        for number in range(30):  # the service is known to be short
            worker.say(asked[0][0], echo(number))
            worker.loop.turn()
        compute = worker.answers.compute

        def take_a_while(queued: QueuedCommand) -> EncodedAnswer:
            worker.loop.now += 0.0009
            return compute(queued)

        worker.answers.compute = take_a_while  # type: ignore[method-assign]
        worker.dispatcher.stateless.leaves_unread = lambda: leaves_unread
        for connection, _ in asked:
            worker.say(connection, echo(100))
        worker.loop.turn()
        before = sum(len(results(wire)) for _, wire in asked)
        worker.loop.now += since_s
        worker.loop.turn()

        assert sum(len(results(wire)) for _, wire in asked) - before == computed
