"""The interface of the queues in which commands wait for their answers, and the values that it passes.

The dispatcher of a worker has a list of queues, and passes each command to the first queue that offers its
service.  All methods are called in the event loop of the worker, and none of them blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import msgspec

from rse_pf.errors import RsePfError
from rse_pf.identity import RobotId
from rse_pf.wire import Command

__all__ = ["CommandQueue", "QueueBacklog", "QueueReport", "QueuedCommand", "RefusedCommand"]


class QueuedCommand(msgspec.Struct, eq=False):
    """One command from its arrival to its answer; times are monotonic seconds.

    Attributes:
        owner: The `RobotConnection` that gets the answer.
        robot: The robot of that connection.
        command: The decoded command.
        size_bytes: Length of the message on the wire, in bytes.
        received_s: Time at which the message arrived.
        deadline_s: Time after which the answer is of no use.
        started_s: Time at which the computation began; 0 while the command waits.
        position: Position in the queue when the command was queued; 1 is the front.  A frame that replaces a
            waiting frame of its stream takes over that frame's position.
        queued_s: Time at which the command, or the first of the frames that it replaced, got that position.
    """

    owner: Any
    robot: RobotId
    command: Command
    size_bytes: int
    received_s: float
    deadline_s: float
    started_s: float = 0.0
    position: int = 1
    queued_s: float = 0.0

    @property
    def allowed_s(self) -> float:
        """Seconds from the arrival of the command to its deadline."""
        return self.deadline_s - self.received_s


class QueueBacklog(NamedTuple):
    """The load of a queue for one more command of a robot, from which its admission is decided.

    Attributes:
        waiting: Number of commands of the robot that wait in the queue.
        pause_s: 0 if the command may be queued; otherwise the server is overloaded, the command is refused,
            and the robot has to pause for this many seconds.
    """

    waiting: int = 0
    pause_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RefusedCommand:
    """A command that is answered with *error* instead of being computed.

    ``reason`` is the label under which the metric ``rse_pf_shed_total`` counts it.
    """

    queued: QueuedCommand
    error: RsePfError
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueReport:
    """The metrics of one queue.

    Attributes:
        gauges: Values for ``/metrics``, by the name of the gauge.
        cpu_s: CPU seconds of other processes that work for this queue, since the start of the worker, by kind
            of work, then by tenant; sandboxes count the elapsed seconds of their requests instead.
        sections: Further parts of the worker's report to the supervisor, by name, such as ``isolation``.
    """

    gauges: Mapping[str, float] = field(default_factory=dict)
    cpu_s: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    sections: Mapping[str, Any] = field(default_factory=dict)


class CommandQueue(Protocol):
    """A queue of commands that wait or run.

    Each queue derives from this class; `enter`, `give_up` and `close` do nothing unless it overrides them.
    """

    checks_scope: bool = False
    """Whether the queue checks the scopes of the robot's token itself; if not, `Admission` requires the scope
    ``services:SERVICE``."""

    @property
    def held(self) -> int:
        """Number of commands that the worker must answer before it exits."""

    def offers(self, service: str) -> bool:
        """Return whether this queue takes commands to *service* now."""

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return the load that decides whether *queued*, whose service this queue offers, is admitted."""

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, which was admitted at *now* (monotonic s), and answer it exactly once later.

        It gets no answer if its connection closes before.
        """

    def withdraw(self, owner: Any, command_id: int) -> None:
        """Cancel the command *command_id* of the connection *owner*, because the robot sent Cancel.

        A queue of short commands may ignore this, since they are answered soon anyway.
        """

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Forget the connection *owner*, which was closed; return those of its commands that are dropped."""

    def report(self) -> QueueReport:
        """Return the present metrics of the queue, and reset none of them."""

    def enter(self, owner: Any) -> None:
        """Note the new connection *owner*, whose handshake was accepted."""
        return

    def give_up(self) -> None:
        """Give up the work that other servers can continue, because this server drains."""
        return

    def close(self) -> None:
        """Stop the threads and processes of this queue; commands that wait or run may get no answer."""
        return
