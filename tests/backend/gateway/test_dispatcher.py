"""The core of a worker on fake wires and a loop that stands still until told."""

from __future__ import annotations

import heapq
import os
import threading
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

from rse_pf.backend.gateway.dispatcher import Dispatcher
from rse_pf.backend.gateway.handshake import Accepted
from rse_pf.backend.log import JsonLog
from rse_pf.backend.object_refs import ObjectRefs
from rse_pf.backend.ports import Clocks
from rse_pf.backend.scheduling.cpu_throttle import CpuThrottle
from rse_pf.backend.scheduling.scheduler import QueuedCommand
from rse_pf.config import PlatformSettings
from rse_pf.object_store import MemoryStore, digest_of, object_name
from rse_pf.service import Registry
from rse_pf.services import echo
from rse_pf.wire import Command, Failure, Hello, Move, Ping, Pong, Result, Welcome, make_codec

CODEC = make_codec("bin")
SETTINGS = PlatformSettings()
BINARY = 2


class FakeLoop:
    """Timers fire when `advance` passes them; nothing else happens."""

    def __init__(self) -> None:
        self.now = 100.0
        self._timers: list[tuple[float, int, Callable[[], object]]] = []

    def call_later(self, delay: float, callback: Callable[[], object]) -> Any:
        heapq.heappush(self._timers, (self.now + delay, len(self._timers), callback))
        return self

    def call_soon_threadsafe(self, callback: Callable[..., object], *args: Any) -> object:
        return callback(*args)

    def cancel(self) -> None: ...

    def advance(self, seconds: float) -> None:
        until = self.now + seconds
        while self._timers and self._timers[0][0] <= until:
            self.now, _, callback = heapq.heappop(self._timers)
            callback()
        self.now = until


class FakeWire:
    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.closed: tuple[int, str] | None = None
        self.pauses: list[float] = []

    def send(self, data: bytes, is_text: bool) -> None:
        self.sent.append(CODEC.decode_from_server(data))

    def send_pong(self, data: bytes) -> None:
        self.sent.append(data)

    def pause(self, seconds: float) -> None:
        self.pauses.append(seconds)

    def close(self, code: int, reason: str) -> None:
        self.closed = (code, reason)


class Large(msgspec.Struct, frozen=True, kw_only=True):
    data: bytes = b""


class Odd(msgspec.Struct, frozen=True, kw_only=True):
    value: Any = None


rests: list[float] = []


@pytest.fixture
def made():
    rests.clear()
    loop, log_fd = FakeLoop(), os.open(os.devnull, os.O_WRONLY)
    settings = PlatformSettings()
    registry = Registry()
    echo.register(registry)

    @registry.service("odd", cheap=True)
    def odd(request: Odd) -> Odd:
        return Odd(value=object())

    @registry.service("large", cheap=True)
    def large(request: Large) -> Large:
        return request

    @registry.service("kept", kind="per_robot_state")
    def kept(request: Odd) -> Odd:
        return request

    log = JsonLog(level="error", server="s-1", wall_clock=lambda: 0.0, fd=log_fd)
    core = Dispatcher(
        settings=settings, registry=registry, server_id="s-1", loop=loop, log=log,
        clocks=Clocks(monotonic=lambda: loop.now, wall=lambda: 5000.0 + loop.now, cpu=lambda: 0.0),
        new_session_id=lambda: "session-1", rest=rests.append,
    )  # fmt: skip
    yield core, loop
    core.close_all()
    log.close()
    os.close(log_fd)


def join(core: Dispatcher, *, expires_s: float | None = None, hello: bool = True) -> tuple[Any, FakeWire]:
    wire = FakeWire()
    admitted = Accepted(robot="r", codec="bin", subprotocol="x", expires_s=expires_s)
    connection = core.connect(wire, admitted)
    if hello:
        say(connection, Hello())
    return connection, wire


def say(connection: Any, message: Any) -> None:
    connection.frame(BINARY, True, False, CODEC.encode(message))


def test_hello_ping_and_a_cheap_command_are_answered_inline(made):
    core, _ = made
    connection, wire = join(core)

    say(connection, Ping(sent_s=1.0))
    say(connection, Command(id=3, service="echo", payload={"value": 1}))

    assert [type(m) for m in wire.sent] == [Welcome, Pong, Result]
    assert connection.session.in_flight == 0


def test_a_reply_that_cannot_be_encoded_is_an_internal_failure(made):
    core, _ = made
    connection, wire = join(core)

    say(connection, Command(id=3, service="odd", payload={}))

    assert isinstance(wire.sent[-1], Failure)
    assert (wire.sent[-1].id, wire.sent[-1].code) == (3, "internal")


def test_a_named_object_is_put_in_by_a_thread_and_a_large_reply_is_named_in_turn(made):
    core, loop = made
    connection, wire = join(core)
    store, data = MemoryStore(), bytes(2 * SETTINGS.session.max_message_bytes)
    core.objects = ObjectRefs(store, SETTINGS.serving, SETTINGS.data.quota_bytes)
    store.put(object_name("default", "r", digest_of(data)), data)
    threads: list[str] = []
    answered = threading.Event()
    get = store.get
    store.get = lambda name: threads.append(threading.current_thread().name) or get(name)
    loop.call_soon_threadsafe = lambda callback, *args: (callback(*args), answered.set())

    say(connection, Command(id=3, service="large", payload={"data": {"object": digest_of(data)}}))

    assert answered.wait(10)
    (result,) = [message for message in wire.sent if isinstance(message, Result)]
    assert (result.id, result.reply) == (3, None)
    reply = msgspec.msgpack.decode(get(object_name("default", "r", result.object)), type=Large)
    assert reply.data == data
    assert set(threads) == {"solver-0"}, "the event loop never waits for the store"


def test_an_object_of_another_robot_is_not_found_and_too_much_is_too_large_without_a_store(made):
    core, _ = made
    connection, _ = join(core)
    foreign, long = digest_of(b"x"), bytes(SETTINGS.session.max_message_bytes - 100)

    store = MemoryStore()
    store.put(object_name("default", "other", foreign), b"x")
    core.objects = ObjectRefs(store, SETTINGS.serving, SETTINGS.data.quota_bytes)
    named = Command(id=4, service="large", payload={"data": {"object": foreign}})
    missing = core._compute(QueuedCommand(connection, "r", named, 9, 0.0, 1.0)).answer
    core.objects = ObjectRefs(None, SETTINGS.serving, SETTINGS.data.quota_bytes)
    inline = Command(id=5, service="large", payload={"data": long + long})
    large = core._compute(QueuedCommand(connection, "r", inline, 9, 0.0, 1.0)).answer

    assert (missing.id, missing.code) == (4, "not-found")
    assert (large.id, large.code) == (5, "too-large")


def test_a_kind_of_service_that_has_no_executor_is_refused(made):
    core, _ = made
    connection, wire = join(core)

    say(connection, Command(id=3, service="kept", payload={}))

    assert wire.sent[-1].code == "unknown-service"
    assert core.held == 0


@pytest.mark.parametrize(
    ("hello", "expires_s", "seconds", "code"),
    [(False, None, 5.0, 4400), (True, None, 5.0, 1001), (True, 5102.0, 2.0, 4401)],
)
def test_sockets_without_hello_life_or_token_are_closed_in_time(made, hello, expires_s, seconds, code):
    core, loop = made
    _, wire = join(core, hello=hello, expires_s=expires_s)

    loop.advance(seconds - 0.1)
    assert wire.closed is None
    loop.advance(1.1)

    assert wire.closed is not None
    assert wire.closed[0] == code


def test_a_robot_that_pings_stays(made):
    core, loop = made
    connection, wire = join(core)

    for _ in range(20):
        loop.advance(2.0)
        say(connection, Ping(sent_s=loop.now))

    assert wire.closed is None


def test_nothing_is_written_behind_a_close(made):
    core, _ = made
    connection, wire = join(core)
    connection.close(1001, "leaving")

    connection.write(CODEC.encode(Move(reason="drain", within_ms=1.0)))
    say(connection, Ping(sent_s=1.0))

    assert [type(m) for m in wire.sent] == [Welcome]


def test_a_robot_that_says_hello_while_the_server_leaves_is_moved(made):
    core, _ = made
    core.move_all("drain", 500.0)

    _, wire = join(core)

    assert [type(m) for m in wire.sent] == [Welcome, Move]


def behind(core: Dispatcher, *, ahead: int = 1) -> None:
    """Let the scheduler be behind, with *ahead* robots waiting for half a second each."""
    core._scheduler.is_behind, core._scheduler._judged_s = True, 100.0
    core._scheduler._turn_s = 0.5
    core._scheduler._round.extend(f"other-{i}" for i in range(ahead))


def test_a_server_that_is_behind_refuses_without_reading(made):
    core, _ = made
    connection, wire = join(core)
    say(connection, Command(id=7, service="echo", payload={"value": 1}, deadline_ms=250.0))
    behind(core)

    say(connection, Command(id=8, service="echo", payload={"value": 1}, deadline_ms=250.0))

    refused = wire.sent[-1]
    assert (refused.id, refused.code) == (8, "busy")
    assert refused.retry_after_ms >= 500.0
    assert connection.session.in_flight == 0
    assert core.metrics.shed["unread"] == 1
    assert core.metrics.requests["echo", "busy"] == 1


def test_the_first_command_of_a_robot_is_read_whatever_waits(made):
    core, _ = made
    connection, wire = join(core)
    behind(core, ahead=1)
    core._scheduler._round.clear()

    say(connection, Command(id=8, service="echo", payload={"value": 1}))

    assert core.metrics.shed["unread"] == 0
    assert isinstance(wire.sent[-1], Result)


def test_hellos_pings_and_unknown_services_are_read_even_behind(made):
    core, _ = made
    behind(core)
    connection, wire = join(core)

    say(connection, Ping(sent_s=1.0))
    say(connection, Command(id=3, service="nothing", payload={}))

    assert [type(m) for m in wire.sent] == [Welcome, Pong, Failure]
    assert wire.sent[-1].code == "unknown-service"
    assert core.metrics.shed["unread"] == 0


def test_one_command_runs_in_each_round_of_the_loop_so_that_the_queue_is_seen(made):
    core, loop = made
    robots = []
    for name in ("a", "b", "c"):
        wire = FakeWire()
        admitted = Accepted(robot=name, codec="bin", subprotocol="x", expires_s=None)
        robots.append((core.connect(wire, admitted), wire))
        say(robots[-1][0], Hello())

    for connection, _ in robots:
        say(connection, Command(id=1, service="echo", payload={"value": 1}))

    assert [sum(isinstance(m, Result) for m in wire.sent) for _, wire in robots] == [1, 0, 0]
    assert core.held == 2
    assert core._ran_inline
    loop.advance(0.0)
    assert not core._ran_inline


def test_the_longest_recent_wait_is_told(made):
    core, loop = made
    connection, _ = join(core)
    core._ran_inline = True
    say(connection, Command(id=1, service="echo", payload={"value": 1}))
    loop.now += 0.3
    core._next_round()

    assert core.snapshot()["gauges"]["queue_ms"] == pytest.approx(300.0)
    loop.now += 3.0
    assert core.snapshot()["gauges"]["queue_ms"] == 0.0


@pytest.mark.parametrize(("is_behind", "rested"), [(True, [0.01]), (False, [])])
def test_a_small_server_out_of_budget_rests_a_moment_only_while_it_is_behind(made, is_behind, rested):
    core, loop = made
    connection, wire = join(core)
    core._gate = CpuThrottle(0.25, 0.02, now=loop.now, cpu_s=-1.0)
    core._scheduler.is_behind, core._scheduler._judged_s = is_behind, loop.now

    say(connection, Command(id=1, service="echo", payload={"value": 1}))

    assert rests == rested
    assert len(wire.sent) == 1, "only the welcome: the budget is used up"


def test_who_sends_garbage_is_read_more_and_more_rarely(made):
    core, _ = made
    connection, wire = join(core)

    for _ in range(3):
        connection.frame(BINARY, True, False, b"garbage")

    assert wire.pauses == pytest.approx([0.1, 0.2, 0.3])
    assert [message.code for message in wire.sent[1:]] == ["bad-message"] * 3


def test_a_flood_is_refused_by_name_and_then_cut_off(made):
    core, loop = made
    connection, wire = join(core)

    for number in range(200):
        say(connection, Command(id=number, service="echo", payload={"value": 1}))
        if wire.closed:
            break

    told = [each for each in wire.sent if isinstance(each, Failure) and "rate" in each.message]
    assert number == 40 + 120 - 1
    assert [each.id for each in told] == list(range(40, 159))
    assert all(each.code == "busy" and each.retry_after_ms > 0 for each in told)
    assert wire.closed == (4429, "rate")
    assert core.rates.rests_s(("default", "r"), loop.now) > 0
    assert core.metrics.shed["rate"] == 120


def test_what_cannot_be_named_is_refused_without_a_name(made):
    core, _ = made
    connection, wire = join(core)

    for _ in range(41):
        say(connection, Ping(sent_s=1.0))

    assert isinstance(wire.sent[-1], Failure)
    assert (wire.sent[-1].code, wire.sent[-1].id) == ("busy", None)
