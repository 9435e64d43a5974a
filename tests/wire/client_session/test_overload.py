"""A robot whose server has too much to do pauses as long as the server says."""

from __future__ import annotations

import math

import pytest

from rse_pf.config import SessionSettings
from rse_pf.wire import Command, Failure, Limits, Ping, Welcome, make_codec
from rse_pf.wire.client_session import Answered, ClientSession, ConnectionState
from rse_pf.wire.rate_limit import MAX_PAUSE_S

CODEC = make_codec("bin")
BUSY = {"code": "busy", "message": "too many commands wait"}


class RefusedSession:
    """A session with one connection, and what it sent and heard."""

    def __init__(self, *, room: int = 100, commands_per_s: float = 0.0) -> None:
        self.session = ClientSession(codec=CODEC, settings=SessionSettings(), sdk="test")
        self.ends: dict[int, str] = {}
        self.sent: list[tuple[float, int]] = []
        self.pings = 0
        self.limits = Limits(
            max_message_bytes=4096, max_in_flight=room, max_commands_per_s=commands_per_s, command_burst=1
        )
        self.connection = self.connect(0.0)

    def connect(self, now: float) -> ConnectionState:
        self.connection = self.session.open_connection(now)
        welcome = Welcome(server="a", session="s", robot="r", protocol=1, clock_s=0.0, limits=self.limits)
        self.session.receive(self.connection, CODEC.encode(welcome), now)
        self.session.adopt(self.connection, now)
        self.take([], now)
        return self.connection

    def submit(self, now: float, stream: str = "", **more) -> int:
        identity = self.session.submit("pnp", None, now=now, stream=stream, **more)
        self.take([], now)
        return identity

    def hear(self, message, now: float) -> None:
        self.take(self.session.receive(self.connection, CODEC.encode(message), now), now)

    def until(self, end: float, now: float) -> None:
        """Let time pass from *now* to *end*."""
        while now < end:
            now = min(end, max(self.session.next_due(now), now + 1e-3))
            self.take(self.session.due(now), now)
            self.take(self.session.check(self.connection, now), now)

    def take(self, events, now: float) -> None:
        for event in events:
            if isinstance(event, Answered):
                answer = event.answer
                self.ends[event.id] = answer.code if isinstance(answer, Failure) else "ok"
        for data in self.connection.outgoing:
            message = CODEC.decode_from_robot(data)
            self.pings += isinstance(message, Ping)
            if isinstance(message, Command):
                self.sent.append((now, message.id))
        self.connection.outgoing.clear()

    @property
    def sent_ids(self) -> list[int]:
        return [identity for _, identity in self.sent]


def test_a_refused_command_is_sent_again_once_after_the_pause():
    robot = RefusedSession()
    identity = robot.submit(0.0)

    for _ in range(2):
        robot.hear(Failure(id=identity, retry_after_ms=200.0, **BUSY), 0.1)
    robot.until(0.29, 0.1)
    assert robot.sent_ids == [identity]
    robot.until(0.31, 0.29)

    assert robot.sent_ids == [identity, identity]
    assert robot.session.held_back == {"busy": 1}


def test_a_refusal_on_a_connection_that_was_left_does_not_end_what_went_to_another():
    robot = RefusedSession()
    identity = robot.submit(0.0)
    old = robot.connection
    robot.session.close_connection(old)
    robot.connect(0.5)

    events = robot.session.receive(old, CODEC.encode(Failure(id=identity, code="failed", message="")), 0.6)

    assert events == []
    assert robot.session.unanswered == 1


@pytest.mark.parametrize("keep", [False, True])
def test_after_busy_no_frame_of_its_stream_is_sent_before_the_pause_is_over(keep: bool):
    robot = RefusedSession()
    first = robot.submit(0.0, "pose", deadline_s=0.15)
    robot.hear(Failure(id=first, retry_after_ms=300.0, **BUSY), 0.1)
    assert robot.ends == {first: "busy"}, "its deadline comes before the end of the pause"

    next_one = robot.submit(0.2, "pose", keep=keep)
    other = robot.submit(0.2, "other")
    alone = robot.submit(0.2)
    robot.until(0.39, 0.2)
    assert robot.sent_ids == [first, other, alone]
    robot.until(0.41, 0.39)

    assert robot.sent_ids == [first, other, alone, next_one]
    assert robot.session.held_back == {"busy": 1}


@pytest.mark.parametrize("pause_ms", [None, 0.0, -1.0, math.nan])
def test_busy_without_a_pause_holds_no_stream_back(pause_ms: float | None):
    robot = RefusedSession()
    first = robot.submit(0.0, "pose", deadline_s=0.05)
    robot.hear(Failure(id=first, retry_after_ms=pause_ms, **BUSY), 0.06)

    fresh = robot.submit(0.07, "pose")

    assert robot.sent_ids == [first, fresh]


@pytest.mark.parametrize("pause_ms", [1e300, math.inf])
def test_no_busy_answer_holds_a_stream_back_for_longer_than_a_minute(pause_ms: float):
    robot = RefusedSession()
    first = robot.submit(0.0, "pose")
    robot.hear(Failure(id=first, retry_after_ms=pause_ms, **BUSY), 0.0)
    assert robot.ends == {first: "busy"}
    waiting = robot.submit(1.0, "pose", deadline_s=3000.0)

    robot.until(MAX_PAUSE_S + 0.01, 59.0)

    assert robot.sent_ids == [first, waiting]


def test_what_the_limits_of_the_welcome_hold_back_is_counted_as_own():
    robot = RefusedSession(room=2)
    for _ in range(5):
        robot.submit(0.0)
    assert robot.session.held_back == {"own-limit": 3}

    slow = RefusedSession(commands_per_s=1.0)
    for _ in range(3):
        slow.submit(0.0)

    assert slow.session.held_back == {"own-limit": 2}


def test_a_frame_that_could_not_wait_ends_at_once_with_the_words_of_the_server():
    robot = RefusedSession()
    first = robot.submit(0.0, "camera", deadline_s=1.0)
    robot.hear(Failure(id=first, retry_after_ms=3000.0, **BUSY), 0.1)

    second = robot.submit(0.2, "camera", deadline_s=1.0, trace="t")
    robot.until(0.21, 0.2)

    assert robot.ends == {first: "busy", second: "busy"}
    assert robot.sent_ids == [first]
    third = robot.submit(2.9, "camera", deadline_s=1.0)
    robot.until(3.2, 2.9)
    assert robot.sent_ids == [first, third]


def test_what_a_server_said_of_a_stream_does_not_count_for_the_next_server():
    robot = RefusedSession()
    first = robot.submit(0.0, "camera", deadline_s=1.0)
    robot.hear(Failure(id=first, retry_after_ms=3000.0, **BUSY), 0.1)

    robot.connect(0.2)
    second = robot.submit(0.3, "camera", deadline_s=1.0)

    assert robot.sent_ids == [first, second]
