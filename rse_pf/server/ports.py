"""What the parts of a worker need of the outside: a socket, an event loop, a log, clocks and settings."""

from __future__ import annotations

import secrets
from asyncio import AbstractEventLoop
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from rse_pf.auth.tokens import Claims
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.recording.tap import RecordingTap
from rse_pf.identity import RobotId
from rse_pf.server.log import JsonLog
from rse_pf.server.metrics import Metrics
from rse_pf.wire.server_session import ServerSession

__all__ = ["Clocks", "CrashMarks", "Log", "NoCrashMarks", "Subscriber", "Wire", "WorkerContext"]


class Wire(Protocol):
    """The socket of one robot; only `rse_pf.server.gateway.websocket`, which makes it, imports picows."""

    def send(self, data: bytes, is_text: bool) -> None:
        """Write one message; does nothing on a socket that ended."""

    def unsent_bytes(self) -> int:
        """Return how many bytes wait in this process, because the kernel does not take more."""

    def bound_unsent(self, max_bytes: int) -> None:
        """Limit the bytes that the kernel holds for the network to *max_bytes*."""

    def send_pong(self, data: bytes) -> None:
        """Write one pong frame."""

    def pause(self, seconds: float) -> None:
        """Read nothing more for *seconds*."""

    def hold(self) -> None:
        """Read nothing more until `read_on` was called as often as this."""

    def read_on(self) -> None:
        """End one `hold`."""

    def close(self, code: int, reason: str) -> None:
        """Write a close frame and end the connection."""


class CrashMarks(Protocol):
    """Where a worker notes for whom it computes; `rse_pf.server.supervisor.crash_report` reads it."""

    of_loop: memoryview
    """The connection for which the thread of the event loop works, in its only element; 0 for none."""

    def enter(self, number: int, robot: RobotId) -> None:
        """Note the robot of the new connection *number*."""

    def compute_for(self, number: int) -> int:
        """Note that this thread works for the connection *number* from now on; return the one before.

        0 stands for none.
        """


class NoCrashMarks:
    """The marks of a process that nobody replaces."""

    def __init__(self) -> None:
        self.of_loop = memoryview(bytearray(8)).cast("Q")

    def enter(self, number: int, robot: RobotId) -> None:
        """Note nothing."""

    def compute_for(self, number: int) -> int:
        """Note nothing."""
        return 0


class Subscriber(Protocol):
    """A robot's connection, as topics and live maps use it, which the gateway stands above.

    Messages are written only as fast as its other end reads them.
    """

    is_connected: bool
    robot: RobotId
    claims: Claims | None
    session: ServerSession | None

    @property
    def unsent_bytes(self) -> int:
        """How much was written that the kernel has not taken."""

    def bound_unsent(self, max_bytes: int) -> None:
        """Limit the bytes that the kernel holds for the network to *max_bytes*."""

    def write(self, data: bytes) -> None:
        """Write one message."""

    def refuse_updates(self, identity: int, error: RsePfError) -> None:
        """Write that the subscription *identity* ends because of *error*."""


class Log(Protocol):
    """Where events go; `rse_pf.server.log.JsonLog` is one."""

    def info(self, event: str, **fields: Any) -> None:
        """Write an event of normal operation."""

    def warning(self, event: str, **fields: Any) -> None:
        """Write an event that an operator should look at."""

    def error(self, event: str, **fields: Any) -> None:
        """Write a defect."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clocks:
    """The clocks of a worker: monotonic s, Unix s, and CPU s of the process."""

    monotonic: Callable[[], float]
    wall: Callable[[], float]
    cpu: Callable[[], float]


def make_session_id() -> str:
    """Return a random id of a session, 16 hexadecimal digits."""
    return secrets.token_hex(8)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerContext:
    """The values that all parts of one worker share.

    Attributes:
        settings: The settings of the platform.
        server_id: The name of the server in welcomes and answers.
        clocks: The clocks of the worker.
        loop: The event loop of the worker.
        log: The log of the worker.
        metrics: The counters of the worker.
        tap: Takes the messages of all connections for a recording; None where nothing is recorded.
        crash: Knows for whom this process computes, if it crashes.
        new_session_id: Makes the id of a session, which goes into its welcome.
    """

    settings: PlatformSettings
    server_id: str
    clocks: Clocks
    loop: AbstractEventLoop
    log: JsonLog
    metrics: Metrics = field(default_factory=Metrics)
    tap: RecordingTap | None = None
    crash: CrashMarks = field(default_factory=NoCrashMarks)
    new_session_id: Callable[[], str] = make_session_id
