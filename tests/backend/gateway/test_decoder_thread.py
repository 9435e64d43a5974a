"""Long messages are read elsewhere: in order for each robot, suspects last, within bounded bytes."""

from __future__ import annotations

import queue
import threading
import zlib
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from rse_pf.backend.gateway.connection import BAD_MESSAGE_PAUSE_S, RobotConnection
from rse_pf.backend.gateway.decoder_thread import DecoderThread, refusal_unread
from rse_pf.backend.gateway.rate_limits import RobotRates
from rse_pf.config import PlatformSettings
from rse_pf.errors import LimitExceeded
from rse_pf.wire import Command, Hello, Ping, Pong, make_codec
from rse_pf.wire.server_session import ServerSession

SETTINGS = PlatformSettings()
CODEC = make_codec("zlib")
SOON_S = 10.0
BOMB = zlib.compress(bytes(3_000_000), 9)
LONG = CODEC.encode(Command(id=7, service="s", payload=list(range(20_000))))


class Loop:
    """Runs what threads ask for when `turn` is called."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue[tuple[Any, ...]] = queue.SimpleQueue()

    def call_soon_threadsafe(self, callback: Any, *args: Any) -> None:
        self._calls.put((callback, *args))

    def turn(self) -> None:
        callback, *args = self._calls.get(timeout=SOON_S)
        callback(*args)


class Wire:
    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.holds = 0
        self.pauses: list[float] = []
        self.closed: tuple[int, str] | None = None

    def close(self, code: int, reason: str) -> None:
        self.closed = (code, reason)

    def send(self, data: bytes, is_text: bool) -> None:
        self.sent.append(CODEC.decode_from_server(data))

    def hold(self) -> None:
        self.holds += 1

    def read_on(self) -> None:
        self.holds -= 1

    def pause(self, seconds: float) -> None:
        self.pauses.append(seconds)


class Dispatcher:
    """As much of the core as a connection asks."""

    def __init__(self, reading: DecoderThread) -> None:
        self.reading = reading
        self.settings = SETTINGS
        self.server_id = "s-1"
        self.rates = RobotRates(SETTINGS.session)
        self.clocks = SimpleNamespace(monotonic=lambda: 50.0)
        self.metrics = SimpleNamespace(closed=Counter(), shed=Counter(), bytes_in=0, bytes_out=0)
        self.connections: set[RobotConnection] = set()
        self.submitted: list[Command] = []

    def submit(self, _connection: RobotConnection, command: Command, _size: int, _now: float) -> None:
        self.submitted.append(command)

    def refuses_unread(self, *_: Any) -> bool:
        return False

    def welcomed(self, *_: Any) -> None: ...

    def disconnect(self, connection: RobotConnection) -> None:
        self.connections.discard(connection)


@pytest.fixture
def loop():
    return Loop()


@pytest.fixture
def reading(loop):
    made = DecoderThread(SETTINGS.serving, call_soon_threadsafe=loop.call_soon_threadsafe)
    yield made
    made.close()


def join(reading: DecoderThread) -> tuple[Dispatcher, RobotConnection, Wire]:
    core, wire = Dispatcher(reading), Wire()
    session = ServerSession(codec=CODEC, robot="r", server="s-1", session="one", limits=SETTINGS.session)
    connection = RobotConnection(core, wire, session, "r", 0.0, None)  # type: ignore[arg-type]
    core.connections.add(connection)
    say(connection, CODEC.encode(Hello()))
    return core, connection, wire


def say(connection: RobotConnection, data: bytes) -> None:
    connection.frame(2, True, False, data)


def test_what_follows_a_long_message_waits_for_it_and_the_socket_rests_meanwhile(loop, reading):
    core, connection, wire = join(reading)

    say(connection, LONG)
    say(connection, CODEC.encode(Command(id=8, service="s")))
    say(connection, LONG)
    say(connection, CODEC.encode(Ping(sent_s=1.0)))
    before = (list(core.submitted), wire.holds)
    loop.turn()
    middle = ([each.id for each in core.submitted], wire.holds)
    loop.turn()

    assert before == ([], 1)
    assert middle == ([7, 8], 1)
    assert [each.id for each in core.submitted] == [7, 8, 7]
    assert isinstance(wire.sent[-1], Pong)
    assert wire.holds == 0


def test_a_short_command_is_read_at_once(reading):
    core, connection, wire = join(reading)

    say(connection, CODEC.encode(Command(id=1, service="s", payload=[1.5] * 1000)))

    assert [each.id for each in core.submitted] == [1]
    assert wire.holds == 0


def test_a_small_bomb_is_inflated_elsewhere_and_its_robot_is_read_more_rarely(loop, reading):
    _, connection, wire = join(reading)
    assert len(BOMB) < reading.short_bytes

    say(connection, BOMB)
    answers_at_once = len(wire.sent)
    loop.turn()

    assert answers_at_once == 1, "only the welcome"
    assert wire.sent[-1].code == "too-large"
    assert wire.pauses == [BAD_MESSAGE_PAUSE_S]


def test_three_long_bombs_end_the_socket_and_the_robot_rests(loop, reading):
    core, connection, wire = join(reading)
    limits = SETTINGS.session
    bomb = zlib.compress(bytes(300_000_000), 9)[: limits.max_message_bytes]
    assert len(bomb) == limits.max_message_bytes

    for _ in range(3):
        assert wire.closed is None
        assert core.rates.rests_s(("default", "r"), 50.0) == 0
        say(connection, bomb)
        loop.turn()

    assert wire.closed == (4400, "too many bad messages")
    assert wire.pauses == pytest.approx([5 * BAD_MESSAGE_PAUSE_S, 10 * BAD_MESSAGE_PAUSE_S])
    assert core.rates.rests_s(("default", "r"), 50.0) == limits.rate_ban_s
    assert core.rates.rests_s(("default", "r2"), 50.0) == 0


def test_a_robot_that_left_meanwhile_submits_nothing(loop, reading):
    core, connection, _ = join(reading)

    say(connection, LONG)
    connection.ended()
    loop.turn()

    assert core.submitted == []


class Held:
    """A codec that reads when it may, and notes what it read."""

    name, is_text = "zlib", False

    def __init__(self) -> None:
        self.may_read = threading.Event()
        self.has_begun = threading.Event()
        self.read: list[bytes] = []

    def decode_from_robot(self, data: bytes) -> Any:
        self.has_begun.set()
        assert self.may_read.wait(SOON_S)
        self.read.append(data)
        raise LimitExceeded("too large")


def test_who_sent_garbage_before_is_read_last_whatever_came_first(loop, reading):
    codec = Held()
    heard: list[Any] = []

    assert reading.begin(codec, b"first", suspicion=0, done=heard.append)
    assert codec.has_begun.wait(SOON_S)
    for data, suspicion in ((b"worst", 2), (b"suspect", 1), (b"honest", 0), (b"honest too", 0)):
        assert reading.begin(codec, data, suspicion=suspicion, done=heard.append)
    codec.may_read.set()
    for _ in range(5):
        loop.turn()

    assert codec.read == [b"first", b"honest", b"honest too", b"suspect", b"worst"]
    assert len(heard) == 5


def test_bytes_that_wait_are_bounded_and_suspects_get_a_quarter(loop):
    most = 1_000_000
    reading = DecoderThread(
        replace(SETTINGS.serving, max_unread_bytes=most), call_soon_threadsafe=loop.call_soon_threadsafe
    )
    codec = Held()

    def begin(size: int, suspicion: int) -> bool:
        return reading.begin(codec, bytes(size), suspicion=suspicion, done=lambda _: None)

    taken = [begin(200_000, 1), begin(100_000, 1), begin(700_000, 0), begin(200_000, 0)]
    codec.may_read.set()
    loop.turn()
    loop.turn()

    assert taken == [True, False, True, False]
    assert begin(most, 0), "there is room again"
    reading.close()


def test_a_message_without_room_is_refused_with_its_number():
    answer = CODEC.decode_from_server(refusal_unread(CODEC, LONG, "s-1"))

    assert (answer.id, answer.code) == (7, "busy")
    assert answer.retry_after_ms > 0
