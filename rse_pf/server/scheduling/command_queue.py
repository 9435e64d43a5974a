"""The interface of the queues in which commands wait for their answers, and the values that it passes.

The dispatcher of a worker holds a list of queues and uses nothing else of them.  All methods are called in
the event loop of the worker, and none of them blocks.
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
        owner: The connection that waits for the answer.
        robot: The robot of that connection.
        command: The command as decoded.
        size_bytes: Its length on the wire.
        received_s: When it arrived.
        deadline_s: After this its answer is of no use.
        started_s: When its computation began; 0 while it waits.
        position: Its position when it was queued, from 1; a frame that replaces a waiting one inherits it.
        queued_s: When that position was taken.
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
        """Time from its arrival to its deadline."""
        return self.deadline_s - self.received_s


class QueueBacklog(NamedTuple):
    """What would delay one more command of a robot.

    Attributes:
        waiting: How many commands of the robot wait in the same queue.
        pause_s: How long the robot has to pause because the command would wait for too long; 0 accepts it.
    """

    waiting: int = 0
    pause_s: float = 0.0


@dataclass(frozen=True, slots=True)
class RefusedCommand:
    """A command that is answered without being computed.

    ``reason`` is a label of the metric ``rse_pf_shed_total``.
    """

    queued: QueuedCommand
    error: RsePfError
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueReport:
    """The metrics of one queue.

    Attributes:
        gauges: Values for ``/metrics``, by the name of the metric.
        cpu_s: CPU seconds since the start of the worker, by kind of work, then by tenant, of work in other
            processes; for sandboxes the elapsed time of their requests.
        sections: Further parts of the worker's report, by their names.
    """

    gauges: Mapping[str, float] = field(default_factory=dict)
    cpu_s: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    sections: Mapping[str, Any] = field(default_factory=dict)


class CommandQueue(Protocol):
    """Commands that wait or run; a queue has this class as its base, and may leave the last methods out."""

    checks_scope: bool = False
    """Whether it checks the scopes of tokens itself, by more than the name of the service."""

    @property
    def held(self) -> int:
        """Commands that the worker must answer before it exits."""

    def offers(self, service: str) -> bool:
        """Return whether this queue takes commands to *service* now."""

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return what would delay *queued*, whose service this queue offers."""

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Take *queued*, which was admitted at *now* (s); answer it once, unless its connection ends."""

    def withdraw(self, owner: Any, command_id: int) -> None:
        """Cancel a command of the connection *owner*, unless it is answered soon."""

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Forget the connection *owner*, which ended; return its commands that are dropped."""

    def report(self) -> QueueReport:
        """Return the present metrics; none is reset."""

    def enter(self, owner: Any) -> None:
        """Note the connection *owner*, whose handshake is done."""
        return

    def give_up(self) -> None:
        """Leave to other servers what they can continue, because this server drains."""
        return

    def close(self) -> None:
        """Stop the threads and processes of this queue; commands that are held may stay unanswered."""
        return
