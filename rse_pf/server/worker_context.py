"""Declare what the parts of a worker process share: clocks, log, settings, metrics, and five interfaces.

The interfaces are `Wire` (a robot's socket), `CrashMarks` (for crash reports), `MessageTap` and
`ServerRecorder` (for recordings), and `Subscriber` (for live maps).
"""

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
        """Write one WebSocket message, as text or binary; do nothing if the socket is closed."""

    def unsent_bytes(self) -> int:
        """Return the bytes in this process's write buffer: written here, and not yet taken by the kernel."""

    def bound_unsent(self, max_bytes: int) -> None:
        """Let the kernel accept bytes of this connection only while fewer than *max_bytes* are unsent there.

        The rest stays in the write buffer of this process, where `unsent_bytes` counts it.
        """

    def send_pong(self, data: bytes) -> None:
        """Write one pong frame with the payload *data*."""

    def pause(self, seconds: float) -> None:
        """Read nothing from the socket for *seconds*; of two pauses the one that lasts longer counts."""

    def hold(self) -> None:
        """Read nothing from the socket until `read_on` was called once for each call of `hold`."""

    def read_on(self) -> None:
        """End one `hold`; reading continues when no hold and no pause is left."""

    def close(self, code: int, reason: str) -> None:
        """Write a close frame with *code* and *reason*, then close the connection."""


class CrashMarks(Protocol):
    """Marks for which connection each thread of a worker works, so that a crash can be charged to a robot.

    `rse_pf.server.supervisor.crash_report.CrashReport` implements this interface.
    """

    of_loop: memoryview
    """One element: the number of the connection for which the event loop's thread works; 0 for none."""

    def enter(self, number: int, robot: RobotId) -> None:
        """Note that the new connection *number* is one of *robot*."""

    def compute_for(self, number: int) -> int:
        """Mark that the calling thread works for the connection *number* from now on; 0 for none.

        Return the number that was marked before, so that the caller can restore it.
        """


class NoCrashMarks:
    """Ignore all marks, for a process that is not replaced after a crash."""

    def __init__(self) -> None:
        self.of_loop = memoryview(bytearray(8)).cast("Q")

    def enter(self, number: int, robot: RobotId) -> None:
        """Ignore the connection."""

    def compute_for(self, number: int) -> int:
        """Ignore the mark and return 0, which stands for no connection."""
        return 0


class MessageTap(Protocol):
    """Observe the messages of all connections of one worker.

    The event loop of the worker calls the methods for every message, so they must return at once and raise
    nothing.
    """

    dropped: int
    """Number of messages that were not recorded, because the recorder was too slow or has ended."""

    def open_connection(self, codec: str, robot: RobotId) -> int:
        """Return a number that identifies a new connection in later calls; *codec* is the codec's name."""

    def observe_received(self, connection: int, data: bytes) -> None:
        """Observe the bytes of a message from the robot, before they are decoded."""

    def observe_command(self, data: bytes, command: Command) -> None:
        """Observe that *data*, the bytes of the message observed last, was decoded to *command*."""

    def observe_sent(self, connection: int, data: bytes) -> None:
        """Observe the bytes of a message to the robot."""

    def observe_answer(self, data: bytes, command: Command, answer: Result | Failure) -> None:
        """Observe that *data*, the bytes of a message to the robot, is *answer* to *command*."""

    def close_connection(self, connection: int) -> None:
        """Observe that the connection with the number *connection* was closed."""

    def flush(self) -> None:
        """Pass all observed messages to the recorder, before the worker exits."""


class NullMessageTap:
    """The tap of a server that records nothing: it ignores all messages, and its ``dropped`` stays 0."""

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
    """Record the messages of one server.

    The supervisor enters it as a context before the workers are forked, and leaves it after they exited.
    """

    pids: list[int]
    """Ids of the recorder's processes, whose CPU time and memory count for the server."""

    def __enter__(self) -> object:
        """Start the recording."""

    def __exit__(self, *_: object) -> None:
        """Finish the recording; all workers have exited."""

    def open_tap(self, call_later: Callable[[float, Callable[[], None]], object], log: Log) -> MessageTap:
        """Return the tap of a worker; called once in each worker process.

        Args:
            call_later: Method of the worker's event loop.
            log: The log of the worker.
        """

    def leave_to_workers(self) -> None:
        """Close the supervisor's copy of the socket to the recorder, after all workers were forked.

        The recorder then notices when the last worker has exited.  Nothing may be forked afterwards.
        """


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
    """The connection of a robot that subscribes to updates of live maps.

    Live maps read ``unsent_bytes`` before they write, so that a slow robot gets only the newest updates.
    """

    is_connected: bool
    robot: RobotId
    claims: Claims | None
    session: ServerSession | None

    @property
    def unsent_bytes(self) -> int:
        """Bytes in this process's write buffer: written here, and not yet taken by the kernel."""

    def bound_unsent(self, max_bytes: int) -> None:
        """Let the kernel accept bytes of this connection only while fewer than *max_bytes* are unsent there.

        The rest stays in the write buffer of this process, where ``unsent_bytes`` counts it.
        """

    def write(self, data: bytes) -> None:
        """Write one encoded message, unless the connection is closing."""

    def refuse_updates(self, identity: int, error: RsePfError) -> None:
        """Send the robot a failure that ends the subscription with the id *identity* because of *error*."""


class Log(Protocol):
    """A log of events with a level and fields, such as `rse_pf.server.log.JsonLog`."""

    def info(self, event: str, **fields: Any) -> None:
        """Log an event of normal operation."""

    def warning(self, event: str, **fields: Any) -> None:
        """Log an event that an operator should look at."""

    def error(self, event: str, **fields: Any) -> None:
        """Log a defect of the platform or of a service."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Clocks:
    """The clocks of a worker; each returns seconds.

    ``monotonic`` is for durations and deadlines, ``wall`` is Unix time, and ``cpu`` is the CPU time that the
    worker process has used.
    """

    monotonic: Callable[[], float]
    wall: Callable[[], float]
    cpu: Callable[[], float]


def make_session_id() -> str:
    """Return a random id for the session of a connection: 16 hexadecimal digits."""
    return secrets.token_hex(8)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerContext:
    """The values that all parts of one worker share.

    Attributes:
        settings: The settings of the platform.
        server_id: The name of the server, as robots get it in the Welcome and in answers.
        clocks: The clocks of the worker.
        loop: The event loop of the worker.
        log: The log of the worker.
        metrics: The counters of the worker.
        tap: Observes the messages of all connections, for a recording.
        crash: Marks for which robot each thread computes, for the report of a crash in native code.
        new_session_id: Returns a new id for the session of a connection, which is sent in its Welcome.
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
