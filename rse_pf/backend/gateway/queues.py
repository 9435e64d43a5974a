"""The queues of commands beside the scheduler's, where a server has none."""

from __future__ import annotations

from typing import Any

from rse_pf.backend.jobs.manager import JobManager
from rse_pf.backend.sandbox.manager import SandboxManager

__all__ = ["JobQueue", "NoQueue", "SandboxQueue"]


class NoQueue:
    """Stands for the sandboxes of a server without installed services, and for jobs that are switched off."""

    held = 0

    def offers(self, service: str) -> bool:
        """Return False: no service is offered, so that nothing is ever submitted."""
        return False

    def waiting_of(self, robot: str) -> int:
        """Return 0."""
        return 0

    def report(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def ignore(self, *_: Any) -> None:
        """Do nothing."""

    submit = connected = disconnected = left = withdraw = give_up = close = ignore


SandboxQueue = SandboxManager | NoQueue
JobQueue = JobManager | NoQueue
