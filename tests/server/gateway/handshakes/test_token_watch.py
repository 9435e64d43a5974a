"""What a worker does with its connections when keys, tokens and newer connections come."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from rse_pf.auth.roster import DenyList, Roster
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.server.gateway.connection import RobotConnection
from rse_pf.server.gateway.handshake import Accepted, RequestHead
from rse_pf.server.log import JsonLog
from rse_pf.wire import SUBPROTOCOLS, Failure, Hello, Renew, Welcome
from tests.kit.fakes import FakeWire
from tests.kit.worker_parts import UNIX_S, WorkerParts, quiet_log

SETTINGS = PlatformSettings()
KEY = SigningKey.from_seed(b"k" * 32, "k1")


class Worker(WorkerParts):
    """A worker whose robots show real tokens."""

    def __init__(self, log: JsonLog) -> None:
        super().__init__(log, keys=KEY.key_set())
        self._number = 0

    def token(self, robot: str = "r", ttl_s: float = 100.0, **more: Any) -> str:
        self._number += 1
        token_id = f"t-{self._number}"
        now = self.clocks.wall()
        return KEY.issue(robot, now=now, token_id=token_id, settings=SETTINGS.auth, ttl_s=ttl_s, **more)

    def record_verdict(self, token: str) -> Accepted:
        """Judge a handshake that is good."""
        accepted = self.handshake.decide(
            RequestHead(
                b"/ws",
                {
                    b"authorization": f"Bearer {token}".encode(),
                    b"sec-websocket-protocol": SUBPROTOCOLS["bin"].encode(),
                },
            ),
            is_full=False, anonymous="a", now_s=self.clocks.wall(),
        )  # fmt: skip
        assert isinstance(accepted, Accepted)
        self._number += 1
        return accepted

    def robot(self, token: str) -> tuple[RobotConnection, FakeWire]:
        """Connect a robot and let it say Hello."""
        accepted = self.record_verdict(token)
        wire = FakeWire()
        connection = self.dispatcher.connect(wire, accepted, self._number)
        self.say(connection, Hello())
        assert isinstance(wire.sent[0], Welcome)
        return connection, wire

    def deny(self, denied: DenyList) -> None:
        self.token_watch.trust(KEY.key_set().with_access_control(Roster(), denied))


@pytest.fixture
def worker() -> Iterator[Worker]:
    with quiet_log() as log:
        made = Worker(log)
        yield made
        made.dispatcher.close_all()


@pytest.mark.parametrize("wrong", ["robot", "tenant", "nonsense", "denied"])
def test_a_token_of_another_robot_does_not_move_the_end(worker: Worker, wrong: str):
    connection, wire = worker.robot(worker.token(ttl_s=10.0))
    worker.deny(DenyList().with_token("default", "r", "t-3", UNIX_S + 900))
    token = {
        "robot": lambda: worker.token("s"), "tenant": lambda: worker.token(tenant="b"),
        "nonsense": lambda: "x", "denied": lambda: worker.token(),
    }[wrong]()  # fmt: skip

    worker.say(connection, Renew(token=token))

    assert isinstance(wire.sent[-1], Failure)
    assert wire.sent[-1].code == "unauthorized"
    connection.last_message_s = worker.loop.now + 1000.0
    worker.loop.advance(10.01)
    assert wire.closed == (4401, "token-over")


def test_a_revocation_between_handshake_and_connection_ends_the_connection(worker: Worker):
    mine, other = worker.record_verdict(worker.token("r")), worker.record_verdict(worker.token("s"))
    worker.deny(DenyList().with_robot("default", "r", UNIX_S + 1))
    wires = FakeWire(), FakeWire()

    for number, (accepted, wire) in enumerate(zip((mine, other), wires, strict=True)):
        worker.dispatcher.connect(wire, accepted, 100 + number)
    worker.loop.advance(0.01)

    assert [wire.closed for wire in wires] == [(4403, "revoked"), None]


def test_a_replaced_connection_ends_and_one_that_is_moving_may_finish_first(worker: Worker):
    (first, wire), (moving, other) = worker.robot(worker.token("r")), worker.robot(worker.token("s"))
    moving.move("rebalance", 3000.0, worker.loop.now)

    worker.token_watch.replace(first.number)
    worker.token_watch.replace(moving.number)

    assert (wire.closed, other.closed) == ((4409, "replaced"), None)
    worker.told.clear()
    moving.last_message_s = worker.loop.now + 1000.0
    worker.loop.advance(3.0)
    assert worker.told == [{"event": "stays", "robot": RobotId("default", "s"), "number": moving.number}]
    worker.token_watch.replace(moving.number)
    assert other.closed == (4409, "replaced")
