"""Any life of a robot's session: every command ends exactly once, in whatever order things break."""

from __future__ import annotations

from collections import Counter

from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rse_pf.wire import Command, Failure, Limits, Ping, Pong, Result, Welcome
from rse_pf.wire.client_session import Answered, ClientSession, ConnectionState, Notice
from tests.kit.client_sessions import CODEC, SETTINGS, make_session, open_connection

ROOM = 3
CODES = ("busy", "worker-lost", "stale", "expired", "internal", "degenerate")

picks = st.integers(0, 10**6)


class RobotLife(RuleBasedStateMachine):
    """The session against a model that only counts ends."""

    def __init__(self) -> None:
        super().__init__()
        self.session = ClientSession(codec=CODEC, settings=SETTINGS, sdk="test")
        self.now = 0.0
        self.connections: list[ConnectionState] = []
        self.seen: list[tuple[ConnectionState, Command]] = []
        self.open_on: dict[int, set[int]] = {}
        self.commands: dict[int, tuple[str, bool]] = {}
        self.cancelled: set[int] = set()
        self.ends: Counter[int] = Counter()
        self.delivered: dict[str, int] = {}
        self.deadline: dict[int, float] = {}

    def _take(self, events: list) -> None:
        for event in events:
            if not isinstance(event, Answered):
                continue
            self.ends[event.id] += 1
            stream, keep = self.commands[event.id]
            if isinstance(event.answer, Result) and stream and not keep:
                assert event.answer.reply >= self.delivered.get(stream, 0)
            if isinstance(event.answer, Result):
                assert self.now < self.deadline[event.id]
                self.delivered[stream] = max(self.delivered.get(stream, 0), event.answer.reply)
        self._read()

    def _read(self) -> None:
        for connection in self.connections:
            for data in connection.outgoing:
                message = CODEC.decode_from_robot(data)
                if isinstance(message, Command):
                    assert not connection.lost
                    assert self.ends[message.id] == 0
                    assert message.id not in self.cancelled
                    assert message.id not in self.open_on[id(connection)]
                    self.open_on[id(connection)].add(message.id)
                    self.seen.append((connection, message))
                elif isinstance(message, Ping) and not connection.lost:
                    pong = Pong(sent_s=message.sent_s, received_s=self.now, answered_s=self.now)
                    self.session.receive(connection, CODEC.encode(pong), self.now)
            connection.outgoing.clear()

    @rule(stream=st.sampled_from(["", "a", "b"]), keep=st.booleans(), deadline_s=st.floats(0.05, 4))
    def submit(self, stream: str, keep: bool, deadline_s: float) -> None:
        identity = self.session.submit(
            "x", None, now=self.now, stream=stream, keep=keep, deadline_s=deadline_s
        )
        self.commands[identity] = (stream, keep)
        self.deadline[identity] = self.now + deadline_s
        self._read()

    @rule(pick=picks)
    @precondition(lambda self: self.commands)
    def cancel(self, pick: int) -> None:
        identity = sorted(self.commands)[pick % len(self.commands)]
        if not self.ends[identity]:
            self.cancelled.add(identity)
        self.session.cancel(identity)

    @rule()
    def connect(self) -> None:
        connection = self.session.open_connection(self.now)
        self.connections.append(connection)
        self.open_on[id(connection)] = set()
        welcome = Welcome(
            server=f"server-{len(self.connections)}", session="s", robot="r", protocol=1, clock_s=self.now,
            limits=Limits(max_message_bytes=4096, max_in_flight=ROOM),
        )  # fmt: skip
        self.session.receive(connection, CODEC.encode(welcome), self.now)
        self._take(self.session.adopt(connection, self.now))

    @rule(pick=picks)
    @precondition(lambda self: self.connections)
    def lose(self, pick: int) -> None:
        self.session.close_connection(self.connections[pick % len(self.connections)])

    @rule(pick=picks, code=st.sampled_from(["", *CODES]), pause_ms=st.sampled_from([None, 0.0, 50.0, 9e5]))
    @precondition(lambda self: self.seen)
    def answer(self, pick: int, code: str, pause_ms: float | None) -> None:
        """Answer any command that was ever sent, again perhaps, on the connection it was sent on."""
        connection, command = self.seen[pick % len(self.seen)]
        message: Result | Failure = Result(id=command.id, reply=command.seq)
        if code:
            message = Failure(id=command.id, code=code, message="", retry_after_ms=pause_ms)
        self.open_on[id(connection)].discard(command.id)
        self._take(self.session.receive(connection, CODEC.encode(message), self.now))

    @rule(seconds=st.floats(0.001, 1.5))
    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now = min(end, max(self.session.next_due(self.now), self.now + 1e-3))
            self._take(self.session.due(self.now))
            for connection in self.connections:
                self._take(self.session.check(connection, self.now))

    @invariant()
    def no_command_ends_twice(self) -> None:
        assert all(count == 1 for count in self.ends.values() if count)
        assert not any(self.ends[identity] for identity in self.cancelled)

    @invariant()
    def the_server_is_never_outrun(self) -> None:
        for connection in self.connections:
            assert self.session.unanswered_on(connection) <= ROOM

    @invariant()
    def nobody_waits_longer_than_the_deadline(self) -> None:
        waiting = [i for i in self.commands if not self.ends[i] and i not in self.cancelled]
        assert len(waiting) == self.session.unanswered
        assert all(self.deadline[i] >= self.now - 1e-3 for i in waiting)

    def teardown(self) -> None:
        self.wait(5.0)
        for identity in self.commands:
            assert self.ends[identity] == (0 if identity in self.cancelled else 1), identity
        assert self.session.unanswered == 0


TestRobotLife = RobotLife.TestCase
TestRobotLife.settings = hypothesis_settings(max_examples=30, stateful_step_count=40, deadline=None)


def test_a_failure_without_an_id_is_a_notice():
    session = make_session()
    told = Failure(code="bad-message", message="what?")

    assert session.receive(session.open_connection(0.0), CODEC.encode(told), 0.1) == [Notice(told)]


def test_an_answer_that_comes_after_the_deadline_is_not_delivered_as_fresh() -> None:
    session = make_session()
    connection = open_connection(session)
    for _ in range(2):
        session.submit("x", None, now=0.0, deadline_s=1.0)

    in_time = session.receive(connection, CODEC.encode(Result(id=1)), 0.99)
    late = session.receive(connection, CODEC.encode(Result(id=2)), 1.0)

    assert [getattr(event.answer, "code", "ok") for event in in_time + late] == ["ok", "expired"]
    assert session.unanswered == 0
