"""Declare what the parts of a worker share: clocks, log, settings, and interfaces of socket and recorder."""

from __future__ import annotations

import secrets
from asyncio import AbstractEventLoop
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from rse_pf.auth.tokens import Claims
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError
from rse_pf.identity import RobotId
from rse_pf.server.log import JsonLog
from rse_pf.server.metrics import Metrics
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.server_session import ServerSession

__all__ = [
    "Clocks", "CrashMarks", "Log", "MessageTap", "NoCrashMarks", "NullMessageTap", "NullServerRecorder",
    "ServerRecorder", "Subscriber", "Wire", "WorkerContext",
]  # fmt: skip


class Wire(Protocol):
    """The socket of one robot; only `rse_pf.server.gateway.websocket`, which makes it, imports picows."""

    def send(self, data: bytes, is_text: bool) -> None:
        """Write one message; does nothing on a socket that ended."""

    def unsent_bytes(self) -> int:
        """Return how many bytes wait in this process, because the kernel does not take more."""

    def bound_unsent(self, max_bytes: int) -> None:
        """Limit the bytes of this connection that the kernel holds and has not sent to *max_bytes*."""

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
    """Notes of a worker for which robot it computes; `rse_pf.server.supervisor.crash_report` has them."""

    of_loop: memoryview
    """The connection for which the thread of the event loop works, in its only element; 0 for none."""

    def enter(self, number: int, robot: RobotId) -> None:
        """Note the robot of the new connection *number*."""

    def compute_for(self, number: int) -> int:
        """Note that this thread works for the connection *number* from now on; return the one before.

        0 stands for none.
        """


class NoCrashMarks:
    """Notes of nothing, for a process that is not replaced after a crash."""

    def __init__(self) -> None:
        self.of_loop = memoryview(bytearray(8)).cast("Q")

    def enter(self, number: int, robot: RobotId) -> None:
        """Note nothing."""

    def compute_for(self, number: int) -> int:
        """Note nothing."""
        return 0


class MessageTap(Protocol):
    """Observe the messages of all connections of one worker.

    The event loop of the worker calls the methods for every message, so they must return at once and raise
    nothing.
    """

    dropped: int
    """Messages that could not be recorded."""

    def open_connection(self, codec: str, robot: RobotId) -> int:
        """Return a number that identifies a new connection in later calls; *codec* is the codec's name."""

    def observe_received(self, connection: int, data: bytes) -> None:
        """Observe the bytes of a message from the robot, before they are decoded."""

    def observe_command(self, data: bytes, command: Command) -> None:
        """Observe the command that *data*, the message that was received last, was decoded to."""

    def observe_sent(self, connection: int, data: bytes) -> None:
        """Observe the bytes of a message to the robot."""

    def observe_answer(self, data: bytes, command: Command, answer: Result | Failure) -> None:
        """Observe which *answer* to which command *data*, the message that was sent last, holds."""

    def close_connection(self, connection: int) -> None:
        """Observe that *connection* has ended."""

    def flush(self) -> None:
        """Pass on what was observed; the worker exits."""


class NullMessageTap:
    """Ignore all messages: the tap of a server that records nothing."""

    def __init__(self) -> None:
        self.dropped = 0

    def open_connection(self, codec: str, robot: RobotId) -> int:
        """Return 0 for every connection."""
        return 0

    def observe_received(self, connection: int, data: bytes) -> None:
        """Ignore a message."""

    def observe_command(self, data: bytes, command: Command) -> None:
        """Ignore a command."""

    def observe_sent(self, connection: int, data: bytes) -> None:
        """Ignore a message."""

    def observe_answer(self, data: bytes, command: Command, answer: Result | Failure) -> None:
        """Ignore an answer."""

    def close_connection(self, connection: int) -> None:
        """Ignore the end of a connection."""

    def flush(self) -> None:
        """Do nothing."""


class ServerRecorder(Protocol):
    """Record the messages of one server; the supervisor enters it before it forks the workers."""

    pids: list[int]
    """The processes of the recorder."""

    def __enter__(self) -> object:
        """Start to record."""

    def __exit__(self, *_: object) -> None:
        """Finish the recording; all workers have exited."""

    def open_tap(self, call_later: Callable[[float, Callable[[], None]], object], log: Log) -> MessageTap:
        """Return the tap of a worker, which calls this after it was forked.

        Args:
            call_later: Of the event loop of the worker.
            log: The log of the worker.
        """

    def leave_to_workers(self) -> None:
        """Note that all workers are forked, so that only they keep the recording open."""


class NullServerRecorder:
    """Record nothing."""

    def __init__(self) -> None:
        self.pids: list[int] = []

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    def open_tap(self, call_later: Callable[[float, Callable[[], None]], object], log: Log) -> MessageTap:
        """Return a tap that ignores all messages."""
        return NullMessageTap()

    def leave_to_workers(self) -> None:
        """Do nothing."""


class Subscriber(Protocol):
    """The connection of a robot that has subscriptions, as live maps use it.

    Messages are written only as fast as the robot reads them.
    """

    is_connected: bool
    robot: RobotId
    claims: Claims | None
    session: ServerSession | None

    @property
    def unsent_bytes(self) -> int:
        """Bytes that were written and that the kernel has not taken."""

    def bound_unsent(self, max_bytes: int) -> None:
        """Limit the bytes of this connection that the kernel holds and has not sent to *max_bytes*."""

    def write(self, data: bytes) -> None:
        """Write one message."""

    def refuse_updates(self, identity: int, error: RsePfError) -> None:
        """Write that the subscription *identity* ends because of *error*."""


class Log(Protocol):
    """Log of events, such as `rse_pf.server.log.JsonLog`."""

    def info(self, event: str, **fields: Any) -> None:
        """Write an event of normal operation."""

    def warning(self, event: str, **fields: Any) -> None:
        """Write an event that an operator should look at."""

    def error(self, event: str, **fields: Any) -> None:
        """Write a defect."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clocks:
    """The clocks of a worker, in seconds: monotonic time, Unix time, and CPU time of the process."""

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
        tap: Observes the messages of all connections, for a recording.
        crash: Notes for which robot this process computes, in case it crashes.
        new_session_id: Makes the id of a session, which goes into its welcome.
    """

    settings: PlatformSettings
    server_id: str
    clocks: Clocks
    loop: AbstractEventLoop
    log: JsonLog
    metrics: Metrics = field(default_factory=Metrics)
    tap: MessageTap = field(default_factory=NullMessageTap)
    crash: CrashMarks = field(default_factory=NoCrashMarks)
    new_session_id: Callable[[], str] = make_session_id
