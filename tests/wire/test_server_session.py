"""The rules of a server's side of one connection, as a table and as a state machine."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rse_pf.config import BurstSettings, SessionSettings
from rse_pf.wire import (
    CODECS,
    Command,
    Failure,
    FromServer,
    Hello,
    Message,
    Move,
    Ping,
    Pong,
    Result,
    Welcome,
    make_codec,
)
from rse_pf.wire.server_session import (
    CLOSE_PROTOCOL,
    CLOSE_UNSUPPORTED,
    Close,
    Send,
    ServerSession,
    Submit,
)
from tests.kit import server_sessions

LIMITS = SessionSettings(max_in_flight=2, max_message_bytes=2048)
MAX_BAD_MESSAGES = 2


@pytest.fixture(autouse=True)
def few_bad_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rse_pf.wire.server_session.MAX_BAD_MESSAGES", MAX_BAD_MESSAGES)


HELLO = Hello(sdk="test")


def session(codec: str = "json") -> ServerSession:
    return ServerSession(
        codec=make_codec(codec, LIMITS), robot="robot-7", server="s1", session="x1", limits=LIMITS
    )


def say(server: ServerSession, message: Message, now: float = 5.0) -> list[Any]:
    """Return the decisions on *message*, with what was sent decoded."""
    return [
        heard(server, each) for each in server_sessions.receive(server, server.codec.encode(message), now)
    ]


def heard(server: ServerSession, decision: Any) -> Any:
    return server.codec.decode_from_server(decision.data) if isinstance(decision, Send) else decision


def opened(codec: str = "json") -> ServerSession:
    server = session(codec)
    say(server, HELLO)
    return server


def test_a_hello_with_capabilities_that_are_gone_is_accepted() -> None:
    [welcome] = say(session(), Hello(capabilities=("move", "progress", "updates", "refusals", "rate")))

    assert isinstance(welcome, Welcome)


@pytest.mark.parametrize("codec", CODECS)
def test_hello_is_answered_with_who_serves_and_what_it_accepts(codec: str) -> None:
    server = session(codec)

    [welcome] = say(server, HELLO, now=12.5)

    assert isinstance(welcome, Welcome)
    assert (welcome.server, welcome.session, welcome.robot, welcome.protocol) == ("s1", "x1", "robot-7", 1)
    assert (welcome.limits.max_message_bytes, welcome.limits.max_in_flight) == (2048, 2)
    assert welcome.clock_s == 12.5
    assert server.state == "open"


def test_another_protocol_version_is_refused_and_closed() -> None:
    server = session()

    failure, close = say(server, Hello(protocol=2))

    assert failure.code == "unsupported"
    assert close.code == CLOSE_UNSUPPORTED
    assert server.state == "closed"


def test_more_unanswered_commands_than_agreed_are_busy_with_a_time() -> None:
    server = opened()
    for number in (1, 2):
        say(server, Command(id=number, service="echo"))

    [busy] = say(server, Command(id=3, service="echo", trace="t3"))

    assert (busy.id, busy.code, busy.trace, busy.server) == (3, "busy", "t3", "s1")
    assert busy.retry_after_ms > 0
    assert busy.hint
    server_sessions.answer(server, Result(id=1))
    assert isinstance(say(server, Command(id=3, service="echo"))[0], Submit)


def test_a_closed_session_ignores_messages() -> None:
    server = session()
    say(server, Command(id=1, service="echo", payload=1, trace="t"))

    assert say(server, HELLO) == []
    assert server_sessions.receive(server, b"nonsense", 1.0) == []
    assert server.move("drain", 100.0) == []


def test_only_an_open_session_is_asked_to_move() -> None:
    assert session().move("drain", 100.0) == []
    server = opened()
    assert [heard(server, each) for each in server.move("drain", 100.0)] == [
        Move(reason="drain", within_ms=100.0)
    ]


class IpcChannel(RuleBasedStateMachine):
    """A robot that says anything, against a model of three counters."""

    def __init__(self) -> None:
        super().__init__()
        self.server = session()
        self.state = "opening"
        self.bad = 0
        self.waiting: list[int] = []
        self.next_id = 0

    @rule(protocol=st.sampled_from([1, 1, 1, 2]))
    def hello(self, protocol: int) -> None:
        said = say(self.server, Hello(protocol=protocol))
        if self.state == "closed":
            assert said == []
        elif self.state == "open":
            assert [type(each) for each in said] == [Close]
            self.state = "closed"
        else:
            assert [type(each) for each in said] == ([Welcome] if protocol == 1 else [Failure, Close])
            self.state = "open" if protocol == 1 else "closed"

    @rule(sent_s=st.floats(0, 1e6), now=st.floats(0, 1e6))
    def ping(self, sent_s: float, now: float) -> None:
        said = say(self.server, Ping(sent_s=sent_s), now)
        self._only_after_hello(said, [Pong(sent_s=sent_s, received_s=now, answered_s=now)])

    @rule()
    def command(self) -> None:
        self.next_id += 1
        command = Command(id=self.next_id, service="echo")
        said = say(self.server, command)
        if self.state == "open" and len(self.waiting) >= LIMITS.max_in_flight:
            assert [each.code for each in said] == ["busy"]
            return
        if self.state == "open":
            self.waiting.append(command.id)
        self._only_after_hello(said, [Submit(command)])

    @rule(data=st.sampled_from([b"", b"[]", b'{"type":"welcome"}', b"\xff", b"[" * 100]))
    def nonsense(self, data: bytes) -> None:
        said = [heard(self.server, each) for each in server_sessions.receive(self.server, data, 1.0)]
        if self.state == "closed":
            assert said == []
            return
        self.bad += 1
        if self.bad > MAX_BAD_MESSAGES:
            assert [type(each) for each in said] == [Failure, Close]
            self.state = "closed"
        else:
            assert [type(each) for each in said] == [Failure]

    @precondition(lambda self: self.waiting)
    @rule(pick=st.integers(0, 9), fails=st.booleans())
    def answer(self, pick: int, fails: bool) -> None:
        number = self.waiting.pop(pick % len(self.waiting))
        message: Result | Failure = (
            Failure(id=number, code="expired", message="m") if fails else Result(id=number)
        )
        answered: FromServer = heard(self.server, server_sessions.answer(self.server, message))
        assert answered == message

    @invariant()
    def the_counters_agree(self) -> None:
        assert self.server.state == self.state
        assert self.server.in_flight == len(self.waiting)

    def _only_after_hello(self, said: list[Any], when_open: list[Any]) -> None:
        if self.state == "open":
            assert said == when_open
        elif self.state == "opening":
            assert said == [Close(CLOSE_PROTOCOL, "say hello first")]
            self.state = "closed"
        else:
            assert said == []


TestConversation = IpcChannel.TestCase


def test_the_welcome_names_the_burst_only_if_there_is_one() -> None:
    def welcome(burst: BurstSettings) -> bytes:
        codec = make_codec("json")
        server = ServerSession(codec=codec, robot="r", server="s", session="x", limits=LIMITS, burst=burst)
        (sent,) = server_sessions.receive(server, codec.encode(HELLO), 0.0)
        assert isinstance(sent, Send)
        return sent.data

    told, none = welcome(BurstSettings(url="/burst", robot_commands_per_day=7)), welcome(BurstSettings())
    assert welcome(BurstSettings(url="/burst", robot_commands_per_day=0)) == none
    message = make_codec("json").decode_from_server(told)

    assert isinstance(message, Welcome)
    assert (message.burst_url, message.limits.burst_commands_per_day) == ("/burst", 7)
    assert b"burst_" not in none, "older clients see what they always saw"
