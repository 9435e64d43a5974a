"""The dispatcher of a worker on fake wires and a loop whose time the test moves."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from backend.gateway.worker_parts import BINARY, UNIX_S, WorkerParts, worker_parts
from backend.scheduling.admitted import fall_behind, queued
from fakes import FakeLoop, FakeWire

from rse_pf.backend.gateway.answers import EncodedAnswer
from rse_pf.backend.gateway.connection import RobotConnection
from rse_pf.backend.scheduling.command_queue import CommandQueue, QueueReport, unmeasured_backlog
from rse_pf.backend.scheduling.scheduler import QueueBacklog, QueuedCommand
from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId, object_name
from rse_pf.object_store import MemoryStore, digest_of
from rse_pf.service import Registry
from rse_pf.wire import Cancel, Command, Failure, Hello, Move, Ping, Pong, Result, Welcome
from rse_pf.wire.messages import MAX_REFUSED_IDS, Rate, Refused
from rse_pf.wire.server_session import RATE, REFUSALS

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


def test_hello_ping_and_a_cheap_command_are_answered_inline(worker: WorkerParts):
    connection, wire = worker.join()

    worker.say(connection, Ping(sent_s=1.0))
    worker.say(connection, echo(3))

    assert [type(m) for m in wire.sent] == [Welcome, Pong, Result]
    assert connection.session is not None
    assert connection.session.in_flight == 0


def test_a_reply_that_cannot_be_encoded_is_an_internal_failure(worker: WorkerParts):
    connection, wire = worker.join()

    worker.say(connection, Command(id=3, service="odd", payload={}))

    assert isinstance(wire.sent[-1], Failure)
    assert (wire.sent[-1].id, wire.sent[-1].code) == (3, "internal")


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


@pytest.mark.parametrize(
    ("hello", "expires_s", "seconds", "code"),
    [(False, None, 5.0, 4400), (True, None, 5.0, 1001), (True, UNIX_S + 2.0, 2.0, 4401)],
)
def test_connections_without_hello_ping_or_token_are_closed_in_time(
    worker: WorkerParts, hello: bool, expires_s: float | None, seconds: float, code: int
):
    _, wire = worker.join(hello=hello, expires_s=expires_s)

    worker.loop.advance(seconds - 0.1)
    assert wire.closed is None
    worker.loop.advance(1.1)

    assert wire.closed is not None
    assert wire.closed[0] == code


def test_a_robot_that_pings_stays(worker: WorkerParts):
    connection, wire = worker.join()

    for _ in range(20):
        worker.loop.advance(2.0)
        worker.say(connection, Ping(sent_s=worker.loop.now))

    assert wire.closed is None


def test_nothing_is_written_behind_a_close(worker: WorkerParts):
    connection, wire = worker.join()
    connection.close(1001, "leaving")

    connection.write(worker.codec.encode(Move(reason="drain", within_ms=1.0)))
    worker.say(connection, Ping(sent_s=1.0))

    assert [type(m) for m in wire.sent] == [Welcome]


def overload(worker: WorkerParts, *, waiting: int = 1) -> None:
    """Let the scheduler be behind, with *waiting* robots that wait half a second each."""
    fall_behind(worker.scheduler, turn_s=0.5, now=worker.loop.now)
    for number in range(waiting):
        worker.scheduler.submit(queued(f"other-{number}", at=worker.loop.now))


def compute_waiting(worker: WorkerParts) -> None:
    """Empty the queue."""
    now = worker.loop.now
    while (started := worker.scheduler.start(now)[0]) is not None:
        worker.scheduler.done(started, now)


def test_a_server_that_is_behind_refuses_without_decoding(worker: WorkerParts):
    connection, wire = worker.join()
    worker.say(connection, echo(7, deadline_ms=250.0))
    overload(worker)

    worker.say(connection, echo(8, deadline_ms=250.0))

    refused = wire.sent[-1]
    assert (refused.id, refused.code) == (8, "busy")
    assert refused.retry_after_ms == pytest.approx(500.0, rel=0.25)
    assert connection.session is not None
    assert connection.session.in_flight == 0
    assert worker.metrics.shed["unread"] == 1
    assert worker.metrics.requests["echo", "busy"] == 1


def test_a_robot_that_was_told_to_pause_is_refused_until_then_although_there_is_room(worker: WorkerParts):
    connection, wire = worker.join()
    worker.say(connection, echo(7, deadline_ms=250.0))
    overload(worker)
    worker.say(connection, echo(8, deadline_ms=250.0))
    compute_waiting(worker)
    told_s, pause_s = worker.loop.now, worker.scheduler.pause_s

    worker.loop.now += 0.7 * pause_s
    left_ms = 1e3 * (connection.paused_s + pause_s - worker.loop.now)
    worker.say(connection, echo(9, deadline_ms=250.0))
    assert refused(wire) == [8, 9]
    assert wire.sent[-1].retry_after_ms == pytest.approx(left_ms)

    worker.loop.now = told_s + 1.51 * worker.scheduler.pause_s
    worker.say(connection, echo(10, deadline_ms=250.0))
    worker.loop.run_until(lambda: bool(results(wire)[1:]))
    assert refused(wire) == [8, 9]
    assert results(wire)[-1].id == 10


@pytest.fixture
def starved() -> Iterator[WorkerParts]:
    """A worker without CPU time for any command, which is behind after the first one of a robot."""
    settings = PlatformSettings.from_dict({"session": {"max_commands_per_s": 0.0}})
    with worker_parts(settings=settings, emulated_cores=0.25) as parts:
        other, _ = parts.join("other")
        parts.say(other, echo(1))
        parts.loop.advance()
        parts.cpu_s = 10.0
        yield parts


def fall_behind_for_good(worker: WorkerParts) -> None:
    overload(worker, waiting=0)
    worker.say(worker.join("waits")[0], echo(1))
    worker.scheduler.submit(queued("another", at=worker.loop.now))


def join_one_that_hears_rates(worker: WorkerParts) -> tuple[RobotConnection, FakeWire]:
    """Connect a robot to a worker that is behind; its share is 2.5 commands a second."""
    connection, wire = worker.join(hello=False)
    worker.say(connection, Hello(capabilities=[RATE, REFUSALS]))
    connection.allowed_s = 0.25
    fall_behind_for_good(worker)
    worker.scheduler.shares.per_s = 2.5
    return connection, wire


def test_a_robot_that_knows_such_messages_is_told_its_share_once_and_many_ends_in_one(starved: WorkerParts):
    connection, wire = join_one_that_hears_rates(starved)

    for number in range(MAX_REFUSED_IDS + 3):
        starved.say(connection, echo(number, deadline_ms=250.0))
    starved.loop.advance(0.01)

    told = wire.sent[1:]
    assert [type(message) for message in told] == [Rate, Refused, Refused]
    assert told[0].commands_per_s == pytest.approx(2.5, rel=0.5)
    assert told[0].for_ms == 1400.0
    assert [*told[1].ids, *told[2].ids] == list(range(MAX_REFUSED_IDS + 3))
    assert told[1].code == "busy"
    assert told[1].retry_after_ms > 0
    assert starved.metrics.requests["echo", "busy"] == MAX_REFUSED_IDS + 3

    starved.scheduler.shares.per_s = 2.0
    starved.loop.now += 1.1
    starved.say(connection, echo(100, deadline_ms=250.0))
    starved.loop.advance(0.01)
    assert [type(message) for message in wire.sent[4:]] == [Rate, Failure]
    assert wire.sent[4].commands_per_s == pytest.approx(2.0, rel=0.5)


def test_a_robot_that_was_told_its_share_is_told_that_it_is_free_once_there_is_room(starved: WorkerParts):
    connection, wire = join_one_that_hears_rates(starved)
    starved.say(connection, echo(0, deadline_ms=250.0))
    starved.scheduler.shares.has_room = True

    for number in range(1, 4):
        starved.say(connection, echo(number, deadline_ms=250.0))

    assert told_for_ms(wire) == [1400.0, 0.0]
    starved.scheduler.shares.has_room = False
    compute_waiting(starved)
    starved.loop.now += 1.2
    starved.say(connection, echo(9, deadline_ms=250.0))
    assert told_for_ms(wire) == [1400.0, 0.0], "a free robot is told nothing again"


def told_for_ms(wire: FakeWire) -> list[float]:
    return [message.for_ms for message in wire.sent if isinstance(message, Rate)]


def test_a_robot_whose_rate_ended_is_told_again_though_its_command_is_taken(starved: WorkerParts):
    connection, wire = join_one_that_hears_rates(starved)
    starved.say(connection, echo(0, deadline_ms=250.0))
    for later_s, told in [(1.5, 2), (3.0, 2)]:
        compute_waiting(starved)
        starved.loop.now += later_s
        connection.paused_s = -math.inf
        starved.say(connection, echo(1, deadline_ms=250.0))
        assert len(told_for_ms(wire)) == told, "a robot that sends so rarely needs no rate"


def test_one_message_frees_the_robots_that_still_keep_to_a_rate(starved: WorkerParts):
    hearing = [join_one_that_hears_rates(starved), *(starved.join(f"r{k}", hello=False) for k in range(2))]
    for connection, _ in hearing[1:]:
        starved.say(connection, Hello(capabilities=[RATE, REFUSALS]))
        connection.allowed_s = 0.25
    for connection, _ in hearing:
        starved.say(connection, echo(0, deadline_ms=250.0))
    ended, gone = hearing[1][0], hearing[2][0]
    ended.rated_until_s = starved.loop.now - 0.1
    starved.dispatcher.disconnect(gone)
    starved.scheduler.shares.has_room = True

    starved.say(hearing[0][0], echo(1, deadline_ms=250.0))

    assert [told_for_ms(wire) for _, wire in hearing] == [[1400.0, 0.0], [1400.0], [1400.0]]


def test_a_message_frees_so_many_robots_that_others_need_not_wait(starved: WorkerParts):
    first, _ = join_one_that_hears_rates(starved)
    hearing = [starved.join(f"r{number}", hello=False) for number in range(50)]
    for connection, _ in hearing:
        starved.say(connection, Hello(capabilities=[RATE, REFUSALS]))
        connection.allowed_s = 0.25
        starved.say(connection, echo(0, deadline_ms=250.0))
    starved.scheduler.shares.has_room = True
    freed = []
    for number in range(2):
        starved.say(first, echo(number, deadline_ms=250.0))
        freed.append(sum(told_for_ms(wire) == [1400.0, 0.0] for _, wire in hearing))

    assert freed == [32, 50]


def test_shares_know_who_is_connected(worker: WorkerParts):
    shares = worker.scheduler.shares
    connections = [worker.join(f"r{number}")[0] for number in range(3)]
    assert shares.connected == 3
    for connection in connections:
        worker.say(connection, echo(1))  # notes how long its commands may wait
        worker.say(connection, echo(2))
    shares.note_free(0.0, 30.0)
    worker.dispatcher.disconnect(connections[0])
    assert shares.connected == 2
    shares.begin(1.0)

    assert shares.per_s == pytest.approx(15.0)


def test_a_robot_that_was_told_no_share_is_not_told_that_it_is_free(starved: WorkerParts):
    connection, wire = join_one_that_hears_rates(starved)
    starved.scheduler.shares.has_room = True

    starved.say(connection, echo(0, deadline_ms=250.0))
    starved.loop.advance(0.01)

    assert [type(message) for message in wire.sent[1:]] == [Failure]


def test_a_robot_that_waited_until_its_next_command_is_not_early_although_others_pause_for_longer(
    starved: WorkerParts,
):
    connection, wire = join_one_that_hears_rates(starved)
    for interval in range(1, 10):
        starved.scheduler.note_refused(starved.loop.now + 0.11 * interval)
    starved.scheduler.shares.per_s = 5.0
    assert starved.scheduler.pause_s == 0.65

    starved.say(connection, echo(0, deadline_ms=250.0))
    starved.loop.advance(0.01)

    told_ms = wire.sent[-1].retry_after_ms
    assert told_ms == pytest.approx(200.0, rel=0.5)
    early_s = connection.paused_s + starved.scheduler.pause_s - connection.last_heard_s
    assert early_s == pytest.approx(1e-3 * told_ms)


def test_a_robot_that_does_not_name_them_gets_neither_rate_nor_refused(starved: WorkerParts):
    connection, wire = starved.join()
    connection.allowed_s = 0.25
    fall_behind_for_good(starved)
    starved.scheduler.shares.per_s = 2.5

    for number in range(3):
        starved.say(connection, echo(number, deadline_ms=250.0))
    starved.loop.advance(0.01)

    assert [type(message) for message in wire.sent[1:]] == [Failure] * 3
    assert refused(wire) == [0, 1, 2]


def test_a_robot_that_left_gets_none_of_the_refusals_that_waited(starved: WorkerParts):
    connection, wire = starved.join(hello=False)
    starved.say(connection, Hello(capabilities=[REFUSALS]))
    connection.allowed_s = 0.25
    fall_behind_for_good(starved)
    starved.say(connection, echo(8, deadline_ms=250.0))
    assert len(wire.sent) == 1, "it waits for others"

    connection.on_socket_end()
    starved.loop.advance(0.01)

    assert len(wire.sent) == 1


def test_a_pause_ends_when_the_server_is_no_longer_behind(worker: WorkerParts):
    connection, wire = worker.join()
    worker.say(connection, echo(7, deadline_ms=250.0))
    overload(worker)
    worker.say(connection, echo(8, deadline_ms=250.0))
    worker.scheduler.is_behind = False
    compute_waiting(worker)

    worker.say(connection, echo(9, deadline_ms=250.0))

    assert refused(wire) == [8]
    assert results(wire)[-1].id == 9


def test_the_first_command_of_a_robot_is_decoded_whatever_waits(worker: WorkerParts):
    connection, wire = worker.join()
    overload(worker, waiting=0)

    worker.say(connection, echo(8))

    assert worker.metrics.shed["unread"] == 0
    assert isinstance(wire.sent[-1], Result)


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


def test_the_longest_recent_wait_is_reported(worker: WorkerParts):
    for name in "abc":
        worker.say(worker.join(name)[0], half(1))
    worker.loop.now += 0.3
    worker.loop.turn()

    assert worker.dispatcher.snapshot()["gauges"]["queue_ms"] == pytest.approx(300.0)
    worker.loop.now += 3.0
    assert worker.dispatcher.snapshot()["gauges"]["queue_ms"] == 0.0


def test_an_emulated_server_without_budget_starts_nothing_until_its_timer():
    with worker_parts(emulated_cores=0.25) as worker:
        connection, wire = worker.join()
        worker.cpu_s = 0.02 + 0.01

        worker.say(connection, echo(1))
        assert results(wire) == []
        worker.loop.advance(0.039)
        assert results(wire) == []
        worker.loop.advance(0.002)

        assert len(results(wire)) == 1


@pytest.mark.parametrize(("emulated_cores", "at_once"), [(0.25, 0), (0.0, 3)])
def test_only_an_emulated_server_that_is_behind_refuses_in_batches(emulated_cores: float, at_once: int):
    with worker_parts(emulated_cores=emulated_cores) as worker:
        connection, wire = worker.join()
        worker.say(connection, echo(1, deadline_ms=250.0))
        worker.loop.advance()
        worker.cpu_s = 10.0
        overload(worker, waiting=0)
        other, _ = worker.join("other")
        worker.say(other, echo(1))
        worker.scheduler.submit(queued("another", at=worker.loop.now))

        for number in (2, 3, 4):
            worker.say(connection, echo(number, deadline_ms=250.0))

        assert len(refused(wire)) == at_once
        if emulated_cores:
            worker.loop.advance(0.01)
        assert refused(wire) == [2, 3, 4]


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


def test_a_message_without_a_recognisable_id_is_refused_without_one(worker: WorkerParts):
    connection, wire = worker.join()

    for _ in range(41):
        worker.say(connection, Ping(sent_s=1.0))

    assert isinstance(wire.sent[-1], Failure)
    assert (wire.sent[-1].code, wire.sent[-1].id) == ("busy", None)


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
        return unmeasured_backlog(self._waiting)

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


def test_each_queue_learns_of_connections_withdrawals_and_the_end_of_the_server():
    queues = [Queue("one"), Queue("two")]
    with worker_parts(queues=queues) as worker:
        connection, _ = worker.join()
        worker.say(connection, Command(id=7, service="two", payload={}))
        worker.say(connection, Cancel(id=7))
        report = worker.dispatcher.snapshot()
        worker.dispatcher.move_all("drain", 500.0)
        connection.on_socket_end()
        connection.on_socket_end()

    for queue in queues:
        assert queue.told == [
            ("enter", connection), ("withdraw", connection, 7), "give-up", ("leave", connection), "close",
        ]  # fmt: skip
    assert [len(queue.submitted) for queue in queues] == [0, 1]
    assert worker.metrics.requests["unknown", "disconnected"] == 1
    assert (report["gauges"]["one"], report["gauges"]["two"]) == (1.0, 1.0)


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


def test_a_connection_that_ends_drops_its_waiting_commands(worker: WorkerParts):
    connection, wire = worker.join()
    other, _ = worker.join("other")
    worker.say(other, half(1))
    worker.say(other, half(2))
    worker.say(connection, echo(2))

    connection.on_socket_end()
    worker.loop.advance()

    assert worker.metrics.requests["echo", "disconnected"] == 1
    assert results(wire) == []
    assert worker.dispatcher.connections == {other}


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
