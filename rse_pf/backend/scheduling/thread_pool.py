"""Run commands away from the event loop, in threads: the solvers let go of the interpreter lock.

A service's ``kind`` chooses its executor; today only ``stateless`` has one.  Promises nothing about
order, and that a result is handed over exactly once.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Generic, Protocol, TypeVar

from rse_pf.backend.scheduling.scheduler import QueuedCommand

__all__ = ["Executor", "SolverThreads"]

Outcome = TypeVar("Outcome")


class Executor(Protocol):
    """Where the commands of one kind of service run; each answers through a callback of its own."""

    def run(self, job: QueuedCommand) -> None:
        """Begin *job* and return at once."""

    def close(self) -> None:
        """Begin nothing more."""


class SolverThreads(Generic[Outcome]):
    """Threads of one worker; *compute* runs in them, *deliver* is told of each outcome there."""

    def __init__(
        self, count: int, compute: Callable[[QueuedCommand], Outcome], deliver: Callable[[Outcome], None]
    ) -> None:
        self._jobs: SimpleQueue[QueuedCommand | None] = SimpleQueue()
        self._compute = compute
        self._deliver = deliver
        self._threads = [
            threading.Thread(target=self._work, name=f"solver-{i}", daemon=True) for i in range(count)
        ]
        for thread in self._threads:
            thread.start()

    def run(self, job: QueuedCommand) -> None:
        """Let the next free thread compute *job*."""
        self._jobs.put(job)

    def close(self) -> None:
        """End the threads when they have nothing left."""
        for _ in self._threads:
            self._jobs.put(None)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._deliver(self._compute(job))
