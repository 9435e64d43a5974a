"""What a worker does with its connections when keys, tokens and newer connections come."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any
from unittest.mock import create_autospec

import pytest
from backend.gateway.test_dispatcher import BINARY, CODEC, FakeWire

from rse_pf.auth.roster import DenyList, Roster
from rse_pf.auth.tokens import SigningKey
from rse_pf.backend.gateway.audit_recorder import AuditRecorder
from rse_pf.backend.gateway.connection import RobotConnection
from rse_pf.backend.gateway.dispatcher import Dispatcher
from rse_pf.backend.gateway.handshake import Accepted, HandshakePolicy
from rse_pf.backend.gateway.token_watch import TokenWatch
from rse_pf.backend.log import JsonLog
from rse_pf.backend.ports import Clocks
from rse_pf.config import PlatformSettings
from rse_pf.service import Registry
from rse_pf.services import echo
from rse_pf.wire import SUBPROTOCOLS, Command, Failure, Hello, Renew, Renewed, Result, Welcome

SETTINGS = PlatformSettings()
KEY = SigningKey.from_seed(b"k" * 32, "k1")
UNIX_S = 1_000_000.0


class Timer:
    """What `StillLoop.call_later` returns."""

    def __init__(self, due_s: float, callback: Callable[[], object]) -> None:
        self.due_s = due_s
        self.callback = callback
        self.is_cancelled = False

    def cancel(self) -> None:
        self.is_cancelled = True


class StillLoop:
    """Timers fire in order when `advance` passes them, unless they were cancelled."""

    def __init__(self) -> None:
        self.now = 100.0
        self._timers: list[Timer] = []

    def call_later(self, delay: float, callback: Callable[[], object]) -> Timer:
        timer = Timer(self.now + delay, callback)
        self._timers.append(timer)
        return timer

    def call_soon_threadsafe(self, callback: Callable[..., object], *args: Any) -> object:
        return callback(*args)

    def advance(self, seconds: float) -> None:
        until = self.now + seconds
        while due := [each for each in self._timers if each.due_s <= until]:
            first = min(due, key=lambda timer: timer.due_s)
            self._timers.remove(first)
            self.now = max(self.now, first.due_s)
            if not first.is_cancelled:
                first.callback()
        self.now = until


class Bench:
    """A core with a door and its standing, on a loop that stands still."""

    def __init__(self, log: JsonLog) -> None:
        self.loop = StillLoop()
        self.began = self.loop.now
        self.told: list[dict[str, Any]] = []
        registry = Registry()
        echo.register(registry)
        clocks = Clocks(monotonic=lambda: self.loop.now, wall=self.wall, cpu=lambda: 0.0)
        self.core = Dispatcher(
            settings=SETTINGS, registry=registry, server_id="s", clocks=clocks, loop=self.loop, log=log,
            new_session_id=lambda: "x", rest=lambda s: None,
        )  # fmt: skip
        self.door = HandshakePolicy(SETTINGS, KEY.key_set())
        self.core.standing = self.standing = TokenWatch(
            self.core, self.door, loop=self.loop, log=log, tell=lambda **said: self.told.append(said),
            witness=create_autospec(AuditRecorder, instance=True),
        )  # fmt: skip
        self._number = 0

    def wall(self) -> float:
        return UNIX_S + self.loop.now - self.began

    def token(self, robot: str = "r", life_s: float = 100.0, **more: Any) -> str:
        self._number += 1
        token_id = f"t-{self._number}"
        now = self.wall()
        return KEY.issue(robot, now=now, token_id=token_id, settings=SETTINGS.auth, life_s=life_s, **more)

    def robot(self, token: str) -> tuple[RobotConnection, FakeWire]:
        """Let a robot in and have it say hello."""
        admitted = self.door.judge(
            path=b"/ws", authorization=f"Bearer {token}", offered=[SUBPROTOCOLS["bin"]], is_full=False,
            anonymous="a", now_s=self.wall(),
        )  # fmt: skip
        assert isinstance(admitted, Accepted)
        self._number += 1
        wire = FakeWire()
        connection = self.core.connect(wire, admitted, self._number)
        self.say(connection, Hello())
        assert isinstance(wire.sent[0], Welcome)
        return connection, wire

    def say(self, connection: RobotConnection, message: Any) -> None:
        connection.frame(BINARY, True, False, CODEC.encode(message))

    def deny(self, denied: DenyList) -> None:
        self.standing.trust(KEY.key_set().governed_by(Roster(), denied))


@pytest.fixture
def bench() -> Iterator[Bench]:
    log_fd = os.open(os.devnull, os.O_WRONLY)
    log = JsonLog(level="error", server="s", wall_clock=lambda: 0.0, fd=log_fd)
    yield Bench(log)
    log.close()
    os.close(log_fd)


def test_a_socket_ends_at_its_tokens_end_and_not_before(bench: Bench):
    connection, wire = bench.robot(bench.token(life_s=10.0))
    assert wire.sent[0].token_s == 10.0

    connection.last_heard_s = bench.loop.now + 9.0
    bench.loop.advance(9.99)
    assert wire.closed is None
    bench.loop.advance(0.02)

    assert wire.closed == (4401, "token-over")


def test_a_fresh_token_moves_the_end(bench: Bench):
    connection, wire = bench.robot(bench.token(life_s=10.0))
    connection.last_heard_s = bench.loop.now + 1000.0
    bench.loop.advance(8.0)

    bench.say(connection, Renew(token=bench.token(life_s=20.0)))
    connection.last_heard_s = bench.loop.now + 1000.0

    assert wire.sent[-1] == Renewed(token_s=20.0)
    bench.loop.advance(19.9)
    assert wire.closed is None
    bench.loop.advance(0.2)
    assert wire.closed == (4401, "token-over")


@pytest.mark.parametrize("wrong", ["robot", "tenant", "nonsense", "denied"])
def test_a_token_that_is_not_this_robots_own_moves_nothing(bench: Bench, wrong: str):
    connection, wire = bench.robot(bench.token(life_s=10.0))
    bench.deny(DenyList().with_token("default", "r", "t-3", UNIX_S + 900))
    token = {
        "robot": lambda: bench.token("s"), "tenant": lambda: bench.token(tenant="b"),
        "nonsense": lambda: "x", "denied": lambda: bench.token(),
    }[wrong]()  # fmt: skip

    bench.say(connection, Renew(token=token))

    assert isinstance(wire.sent[-1], Failure)
    assert wire.sent[-1].code == "unauthorized"
    connection.last_heard_s = bench.loop.now + 1000.0
    bench.loop.advance(10.01)
    assert wire.closed == (4401, "token-over")


def test_a_denial_ends_the_sockets_it_means_and_no_other(bench: Bench):
    (_, mine), (_, other) = bench.robot(bench.token("r")), bench.robot(bench.token("s"))

    bench.deny(DenyList().with_robot("default", "r", 0.0))

    assert (mine.closed, other.closed) == ((4403, "revoked"), None)
    assert bench.door.renewed(bench.token("r"), bench.wall()) == "disabled"


def test_a_replaced_socket_ends_and_one_that_is_moving_gets_its_time(bench: Bench):
    (first, wire), (moving, other) = bench.robot(bench.token("r")), bench.robot(bench.token("s"))
    moving.move("rebalance", 3000.0, bench.loop.now)

    bench.standing.replace(first.number)
    bench.standing.replace(moving.number)

    assert (wire.closed, other.closed) == ((4409, "replaced"), None)
    bench.told.clear()
    moving.last_heard_s = bench.loop.now + 1000.0
    bench.loop.advance(3.0)
    assert bench.told == [{"event": "stays", "tenant": "default", "robot": "s", "number": moving.number}]
    bench.standing.replace(moving.number)
    assert other.closed == (4409, "replaced")


def test_the_supervisor_hears_who_comes_and_goes(bench: Bench):
    connection, _ = bench.robot(bench.token("r"))
    bench.core.disconnect(connection)
    bench.standing.replace(connection.number)

    said = {"tenant": "default", "robot": "r", "number": connection.number}
    assert bench.told == [{"event": "arrived", **said}, {"event": "left", **said}]


def test_a_service_outside_of_the_scopes_is_forbidden_and_counted(bench: Bench):
    (narrow, refused), (wide, answered) = (
        bench.robot(bench.token("r", scopes=("services:pnp", "data:read"))),
        bench.robot(bench.token("s", scopes=("services:*",))),
    )
    for connection in (narrow, wide):
        bench.say(connection, Command(id=7, service="echo", payload={"value": 1}))
    bench.loop.advance(0.01)

    assert isinstance(refused.sent[-1], Failure)
    assert (refused.sent[-1].id, refused.sent[-1].code) == (7, "forbidden")
    assert bench.core.metrics.requests["echo", "forbidden"] == 1
    assert isinstance(answered.sent[-1], Result)
