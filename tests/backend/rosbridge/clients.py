"""Rosbridge clients of one worker on a `FakeLoop`, and what they were told."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from backend.gateway.worker_parts import BINARY, UNIX_S, WorkerParts, worker_parts
from fakes import FakeWire

from rse_pf.auth.tokens import SigningKey
from rse_pf.backend.gateway.connection import RobotConnection
from rse_pf.backend.gateway.handshake import Accepted, HandshakeRequest
from rse_pf.backend.ports import WorkerContext
from rse_pf.backend.rosbridge.peers import NoPeers
from rse_pf.backend.rosbridge.topics import RosbridgeTopics, TopicPeers
from rse_pf.config import PlatformSettings

KEY = SigningKey.from_seed(b"k" * 32, "platform-1")
TEXT = 1
UNLIMITED = {"max_commands_per_s": 0.0}


class TextWire(FakeWire):
    """A socket that keeps what was sent as Python values."""

    def send(self, data: bytes, is_text: bool) -> None:
        assert is_text, "rosbridge is text"
        self.sent.append(json.loads(data))


class Client:
    """One client: its connection, and its side of the socket."""

    def __init__(self, parts: WorkerParts, accepted: Accepted) -> None:
        self.parts = parts
        self.wire = TextWire()
        self.connection: RobotConnection = parts.dispatcher.connect(self.wire, accepted)

    def say(self, *operations: Any) -> list[Any]:
        """Send operations, as values or as bytes; return what was told until then."""
        for each in operations:
            data = each if isinstance(each, bytes) else json.dumps(each).encode()
            self.connection.receive_frame(TEXT if _is_text(data) else BINARY, True, False, data)
        self.parts.loop.advance(0.01)
        return self.told()

    def told(self) -> list[Any]:
        """Return, once, what the client was told."""
        told, self.wire.sent = self.wire.sent, []
        return told

    @property
    def closed(self) -> int:
        """The close code; 0 while the socket is open."""
        return 0 if self.wire.closed is None else self.wire.closed[0]


class Worker:
    """A worker with rosbridge."""

    def __init__(self, parts: WorkerParts) -> None:
        self.parts = parts
        self.count = 0

    def token(self, robot: str, **more: Any) -> str:
        self.count += 1
        settings = self.parts.settings.auth
        return KEY.issue(robot, now=UNIX_S, token_id=f"t-{self.count}", settings=settings, **more)

    def judge(self, authorization: str = "", path: bytes = b"/rosbridge", **more: Any) -> Any:
        return self.parts.handshake.judge(
            HandshakeRequest(path=path, authorization=authorization, offered=[""], **more),
            is_full=False, anonymous=f"anonymous-{self.count}", now_s=UNIX_S,
        )  # fmt: skip

    def client(self, robot: str = "r", **more: Any) -> Client:
        """Connect a robot with its token in the header."""
        return Client(self.parts, self.judge(f"Bearer {self.token(robot, **more)}"))

    def stranger(self) -> Client:
        """Connect somebody without a token."""
        return Client(self.parts, self.judge())


@contextmanager
def rosbridge_worker(
    *, peers: TopicPeers | None = None, session: dict[str, Any] | None = None, **serving: Any
) -> Iterator[Worker]:
    """Yield a worker; *session* and *serving* are settings, and no rate is limited unless they say so."""
    settings = PlatformSettings.from_dict(
        {"serving": {"rosbridge": True, **serving}, "session": {**UNLIMITED, **(session or {})}}
    )

    def topics(context: WorkerContext) -> RosbridgeTopics:
        return RosbridgeTopics(
            loop=context.loop, clock=context.clocks.monotonic, services=("echo", "pnp"),
            peers=peers or NoPeers(),
        )  # fmt: skip

    with worker_parts(settings=settings, keys=KEY.key_set(), topics=topics) as parts:
        yield Worker(parts)


def _is_text(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True


def call(service: str = "/echo", identity: Any = "call:1", **more: Any) -> dict[str, Any]:
    """Return a call of *service*."""
    return {"op": "call_service", "id": identity, "service": service, **more}
