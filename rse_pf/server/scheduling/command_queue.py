"""The one protocol of everything in which the commands of a worker wait for their answers.

The dispatcher of a worker holds a list of queues and knows nothing else of them.  All methods are called in
the event loop of the worker, and none of them blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from rse_pf.server.scheduling.scheduler import QueueBacklog, QueuedCommand

__all__ = ["CommandQueue", "QueueReport"]


@dataclass(frozen=True, slots=True, kw_only=True)
class QueueReport:
    """The numbers of one queue.

    Attributes:
        gauges: For ``/metrics``, by their names.
        cpu_s: Processor time by kind of work and tenant, of work outside of the worker's own threads.
        sections: Further parts of the worker's report, by their names.
    """

    gauges: Mapping[str, float] = field(default_factory=dict)
    cpu_s: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    sections: Mapping[str, Any] = field(default_factory=dict)


class CommandQueue(Protocol):
    """Commands that wait or run; a queue names this class as its base and may leave the last methods out."""

    judges_scope: bool = False
    """Whether it checks the scopes of tokens itself, by more than the name of the service."""

    @property
    def held(self) -> int:
        """Commands that the worker must answer before it ends."""

    def offers(self, service: str) -> bool:
        """Return whether commands to *service* wait here, now."""

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return what would delay *queued*, which is offered here."""

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Take *queued*, which was admitted at *now*; it is answered once, unless its connection ends."""

    def withdraw(self, owner: Any, command_id: int) -> None:
        """The robot of the connection *owner* cancelled a command: end it, unless it is answered soon."""

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Forget the connection *owner*, which ended; return its commands that are dropped."""

    def report(self) -> QueueReport:
        """Return the present numbers."""

    def enter(self, owner: Any) -> None:
        """Note the connection *owner*, whose robot is known from now on."""
        return

    def give_up(self) -> None:
        """The server drains: leave to other servers what they can go on with."""
        return

    def close(self) -> None:
        """End what works for this queue; commands that are held may stay unanswered."""
        return
