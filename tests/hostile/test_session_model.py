"""Both sides of the protocol together: sockets break, robots are disabled, foreign bytes are inserted.

A robot's session, real server sessions and real tokens; nothing is faked but the network.  The model only
counts: each command ends once, one session of a robot lives, and none of a robot that is disabled.
"""

from __future__ import annotations

from collections import Counter, deque

import pytest
import server_sessions
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rse_pf.auth.roster import DenyList, Roster
from rse_pf.auth.tokens import SigningKey, verify_token
from rse_pf.config import AuthSettings, SessionSettings
from rse_pf.errors import Unauthorized
from rse_pf.wire import Command, Failure, Result, make_codec
from rse_pf.wire.client_session import Answered, ClientSession, ConnectionState, Welcomed
from rse_pf.wire.server_session import Close, Send, ServerSession, Submit

LIMITS = SessionSettings(max_in_flight=3)
CODEC = make_codec("json", LIMITS)
AUTH = AuthSettings()
KEY = SigningKey.from_seed(b"m" * 32, "model-1")
ROBOT, TENANT = "robot-7", "default"
CODES = ("busy", "worker-lost", "stale", "internal", "degenerate")

rarely = st.integers(0, 3).map(lambda drawn: drawn == 3)
picks = st.integers(0, 10**6)


@pytest.fixture(autouse=True)
def few_bad_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rse_pf.wire.server_session.MAX_BAD_MESSAGES", 2)


class Socket:
    """One connection: what is under way in each direction, and what its server still has to answer."""

    def __init__(self, link: ConnectionState, server: ServerSession) -> None:
        self.link = link
        self.server = server
        self.up: deque[bytes] = deque()
        self.down: deque[bytes] = deque()
        self.jobs: list[Command] = []
        self.is_open = True


class Platform(RuleBasedStateMachine):
    """A robot and its servers."""

    def __init__(self) -> None:
        super().__init__()
        self.robot = ClientSession(codec=CODEC, settings=LIMITS, sdk="model")
        self.now = 1000.0
        self.sockets: list[Socket] = []
        self.denied = DenyList()
        self.issued = 0
        self.commands: set[int] = set()
        self.ends: Counter[int] = Counter()

    def _open(self) -> list[Socket]:
        return [socket for socket in self.sockets if socket.is_open]

    def _close(self, socket: Socket) -> None:
        socket.is_open = False
        socket.up.clear()
        socket.down.clear()
        self.robot.close_connection(socket.link)

    def _note(self, events: list) -> None:
        for event in events:
            if isinstance(event, Answered):
                self.ends[event.id] += 1
        for socket in self.sockets:
            if socket.is_open:
                socket.up.extend(socket.link.outgoing)
            socket.link.outgoing.clear()

    @rule(deadline_s=st.floats(0.5, 4), count=st.integers(1, 5))
    def submit(self, deadline_s: float, count: int) -> None:
        for _ in range(count):
            self.commands.add(self.robot.submit("echo", None, now=self.now, deadline_s=deadline_s))
        self._note([])

    @rule(greets=st.sampled_from([True, True, True, False]), again=rarely)
    def connect(self, greets: bool, again: bool) -> None:
        if self._open() and not again:
            return
        self.issued += 1
        token = KEY.issue(ROBOT, now=self.now, token_id=f"t-{self.issued}", settings=AUTH)
        keys = KEY.key_set().with_access_control(Roster(), self.denied)
        try:
            claims = verify_token(token, keys=keys, now=self.now, settings=AUTH)
        except Unauthorized:
            assert self.denied.is_disabled(TENANT, ROBOT)
            return
        assert not self.denied.is_disabled(TENANT, ROBOT)
        for older in self._open():
            self._close(older)
        server = ServerSession(
            codec=CODEC, robot=claims.robot.name, server=f"s-{self.issued}", session="x", limits=LIMITS
        )
        self.sockets.append(Socket(self.robot.open_connection(self.now), server))
        self._note([])
        if greets:
            self.carry_up(1)
            self.carry_down(1)

    @rule(really=rarely)
    def disable(self, really: bool) -> None:
        if not really:
            return
        self.denied = self.denied.with_robot(TENANT, ROBOT, self.now)
        for socket in self._open():
            self._close(socket)

    @rule()
    def enable(self) -> None:
        self.denied = self.denied.without_robot(TENANT, ROBOT)

    @rule(really=rarely)
    @precondition(lambda self: self._open())
    def lose(self, really: bool) -> None:
        if really:
            self._close(self._open()[0])

    @rule(count=st.integers(1, 9))
    @precondition(lambda self: self._open() and self._open()[0].up)
    def carry_up(self, count: int) -> None:
        socket = self._open()[0]
        for _ in range(min(count, len(socket.up))):
            if socket.is_open:
                self._obey(socket, server_sessions.receive(socket.server, socket.up.popleft(), self.now))

    @rule(data=st.sampled_from([b"", b"[]", b"\xff", b'{"type":"welcome"}', b"[" * 99]))
    @precondition(lambda self: self._open())
    def foreign_bytes(self, data: bytes) -> None:
        socket = self._open()[0]
        self._obey(socket, server_sessions.receive(socket.server, data, self.now))

    def _obey(self, socket: Socket, decisions: list) -> None:
        for decision in decisions:
            if isinstance(decision, Send):
                socket.down.append(decision.data)
            elif isinstance(decision, Submit):
                socket.jobs.append(decision.command)
            elif isinstance(decision, Close):
                self._close(socket)

    @rule(count=st.integers(1, 9))
    @precondition(lambda self: self._open() and self._open()[0].down)
    def carry_down(self, count: int) -> None:
        socket = self._open()[0]
        for _ in range(min(count, len(socket.down))):
            events = self.robot.receive(socket.link, socket.down.popleft(), self.now)
            if any(isinstance(event, Welcomed) for event in events):
                events = [*events, *self.robot.adopt(socket.link, self.now)]
            self._note(events)

    @rule(pick=picks, code=st.sampled_from(["", "", "", *CODES]))
    @precondition(lambda self: any(socket.jobs for socket in self.sockets))
    def work(self, pick: int, code: str) -> None:
        """A server finishes a command, perhaps for a socket that is long gone."""
        busy = [socket for socket in self.sockets if socket.jobs]
        socket = busy[pick % len(busy)]
        job = socket.jobs.pop(pick % len(socket.jobs))
        answer: Result | Failure = Result(id=job.id, reply=1)
        if code:
            answer = Failure(id=job.id, code=code, message="", retry_after_ms=10.0)
        data = server_sessions.answer(socket.server, answer).data
        if socket.is_open:
            socket.down.append(data)

    @rule(codes=st.lists(st.sampled_from(["", "", "", *CODES]), min_size=1, max_size=3))
    @precondition(lambda self: self._open())
    def serve(self, codes: list[str]) -> None:
        """All goes well for a moment: what was sent arrives, is worked at, and is answered."""
        self.carry_up(9)
        for code in codes:
            if self._open() and self._open()[0].jobs:
                self.work(0, code)
        if self._open():
            self.carry_down(9)

    @rule(seconds=st.floats(0.001, 0.4))
    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.now = min(end, max(self.robot.next_due(self.now), self.now + 1e-3))
            self._note(self.robot.due(self.now))
            for socket in self._open():
                self._note(self.robot.check(socket.link, self.now))
                if socket.link.lost:
                    self._close(socket)

    @invariant()
    def no_command_ends_twice(self) -> None:
        assert all(self.ends[identity] <= 1 for identity in self.commands)
        assert self.ends.keys() <= self.commands

    @invariant()
    def one_session_lives_and_none_of_a_disabled_robot(self) -> None:
        assert len(self._open()) <= (0 if self.denied.is_disabled(TENANT, ROBOT) else 1)

    @invariant()
    def a_server_has_what_it_took_and_no_more_than_it_said(self) -> None:
        for socket in self.sockets:
            assert socket.server.in_flight == len(socket.jobs) <= LIMITS.max_in_flight

    def teardown(self) -> None:
        self.wait(5.0)
        assert all(self.ends[identity] == 1 for identity in self.commands)
        assert self.robot.unanswered == 0


TestPlatform = Platform.TestCase
TestPlatform.settings = hypothesis_settings(max_examples=30, stateful_step_count=30, deadline=None)


@pytest.mark.slow
@pytest.mark.timeout(900)
class TestPlatformForLong(Platform.TestCase):
    """The same, two thousand lives."""

    settings = hypothesis_settings(max_examples=2000, stateful_step_count=30, deadline=None)
