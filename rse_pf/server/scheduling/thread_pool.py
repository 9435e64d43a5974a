"""Compute commands in threads beside the event loop; solvers and waits release the interpreter lock."""

from __future__ import annotations

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Generic, TypeVar

from rse_pf.server.scheduling.scheduler import QueuedCommand

__all__ = ["SOLVER_THREADS", "SolverThreads"]

Outcome = TypeVar("Outcome")


SOLVER_THREADS = 1
"""Solver threads of each worker: a second one would wait for the interpreter lock; there is a worker for each
core."""


class SolverThreads(Generic[Outcome]):
    """Threads of one worker; *compute* and *deliver* run in them.  They start with the first command."""

    def __init__(
        self,
        count: int,
        compute: Callable[[QueuedCommand], Outcome],
        deliver: Callable[[Outcome], object],
        *,
        name: str = "solver",
    ) -> None:
        self._commands: SimpleQueue[QueuedCommand | None] = SimpleQueue()
        self._compute = compute
        self._deliver = deliver
        self._threads = [
            threading.Thread(target=self._work, name=f"{name}-{number}", daemon=True)
            for number in range(count)
        ]
        self._is_started = False

    def run(self, queued: QueuedCommand) -> None:
        """Give *queued* to the next free thread; call it from one thread."""
        if not self._is_started:
            self._is_started = True
            for thread in self._threads:
                thread.start()
        self._commands.put(queued)

    def close(self) -> None:
        """End the threads when they have nothing left."""
        for _ in self._threads:
            self._commands.put(None)

    def _work(self) -> None:
        while (queued := self._commands.get()) is not None:
            self._deliver(self._compute(queued))
