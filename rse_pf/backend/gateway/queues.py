"""The queues of commands that the scheduler does not run: sandboxes and jobs, or their absence.

`rse_pf.backend.sandbox.manager.SandboxManager` and `rse_pf.backend.jobs.manager.JobManager` are the real
ones.
"""

from __future__ import annotations

from typing import Any, Protocol

from rse_pf.backend.scheduling.scheduler import QueuedCommand

__all__ = ["JobQueue", "NoJobs", "NoSandboxes", "SandboxQueue"]


class SandboxQueue(Protocol):
    """Runs the commands of installed services, each robot's in its own sandbox."""

    @property
    def held(self) -> int:
        """Commands that wait or run."""

    def offers(self, service: str) -> bool:
        """Return whether *service* is an installed one."""

    def waiting_of(self, robot: str) -> int:
        """Return how many commands of *robot* wait."""

    def submit(self, queued: QueuedCommand) -> None:
        """Run an admitted command."""

    def connected(self, robot: str) -> None:
        """Note a connection of *robot*."""

    def disconnected(self, robot: str) -> None:
        """Note the end of a connection of *robot*."""

    def report(self) -> dict[str, Any]:
        """Return what /status shows of sandboxes; empty without installed services."""

    def close(self) -> None:
        """End every sandbox."""


class JobQueue(Protocol):
    """Runs long services."""

    def waiting_of(self, robot: str) -> int:
        """Return how many commands of *robot* wait."""

    def submit(self, queued: QueuedCommand) -> None:
        """Begin an admitted command, or follow its job."""

    def withdraw(self, connection: Any, identity: int) -> None:
        """Cancel a command."""

    def left(self, connection: Any) -> None:
        """Forget the commands of a connection that ended."""

    def give_up(self) -> None:
        """Let other servers go on with all jobs, and take no more."""

    def close(self) -> None:
        """Give all jobs up and wait a little until that is written down."""


class NoSandboxes:
    """A server without installed services."""

    held = 0

    def offers(self, service: str) -> bool:
        """Return False."""
        return False

    def waiting_of(self, robot: str) -> int:
        """Return 0."""
        return 0

    def report(self) -> dict[str, Any]:
        """Return nothing."""
        return {}

    def submit(self, queued: QueuedCommand) -> None:
        """Never called: no service is offered."""
        raise NotImplementedError

    def connected(self, robot: str) -> None:
        """Ignore it, as `disconnected` and `close` do."""

    disconnected = connected

    def close(self) -> None:
        """Close nothing."""


class NoJobs:
    """A server that runs no long services."""

    def waiting_of(self, robot: str) -> int:
        """Return 0."""
        return 0

    def submit(self, queued: QueuedCommand) -> None:
        """Never called: no service is offered."""
        raise NotImplementedError

    def withdraw(self, connection: Any, identity: int) -> None:
        """Withdraw nothing."""

    def left(self, connection: Any) -> None:
        """Forget nothing."""

    def give_up(self) -> None:
        """Give nothing up."""

    close = give_up
