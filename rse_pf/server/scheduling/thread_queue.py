"""Commands that wait in the order of a `Scheduler` and are computed in threads beside the event loop.

Everything but the computation of an answer runs in the event loop.
"""

from __future__ import annotations

import threading
from asyncio import AbstractEventLoop
from collections.abc import Callable, Iterable
from queue import SimpleQueue
from typing import Generic, TypeVar

from rse_pf.server.scheduling.command_queue import (
    CommandQueue,
    QueueBacklog,
    QueuedCommand,
    RefusedCommand,
)
from rse_pf.server.scheduling.scheduler import Scheduler

__all__ = ["ThreadQueue"]

Answer = TypeVar("Answer")


class ThreadQueue(CommandQueue, Generic[Answer]):
    """Commands of some services, which wait or run; *compute* runs in the threads, in several at a time."""

    def __init__(
        self,
        services: Iterable[str],
        *,
        threads: int,
        loop: AbstractEventLoop,
        monotonic: Callable[[], float],
        compute: Callable[[QueuedCommand], Answer],
        send: Callable[[Answer, float], object],
        send_refusal: Callable[[RefusedCommand, float], object],
    ) -> None:
        """Compute nothing yet; the threads start with the first command that needs them.

        Args:
            services: Names of the services that this queue offers.
            threads: Commands that run at the same time.
            loop: Event loop of the worker.
            monotonic: Its clock, in seconds.
            compute: Makes the answer to a command; must not raise.
            send: Sends an answer, at a time in seconds.
            send_refusal: Answers a command that is not computed, at a time in seconds.
        """
        self.scheduler = Scheduler(max_running=threads)
        self._services = frozenset(services)
        self._loop = loop
        self._monotonic = monotonic
        self._compute = compute
        self._send = send
        self._send_refusal = send_refusal
        self._thread_count = threads
        self._threads: list[threading.Thread] = []
        self._to_compute: SimpleQueue[QueuedCommand | None] = SimpleQueue()

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        return self.scheduler.waiting + self.scheduler.running

    def offers(self, service: str) -> bool:
        """Return whether *service* is one of this queue."""
        return service in self._services

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return what would delay *queued*, see `Scheduler.backlog`."""
        return self.scheduler.backlog(queued)

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, which was admitted at *now* (s), and start the commands that may run."""
        self._refuse(self.scheduler.submit(queued), now)
        self._start()

    def withdraw(self, owner: object, command_id: int) -> None:
        """Do nothing: the command is answered before its deadline."""

    def leave(self, owner: object) -> list[QueuedCommand]:
        """Drop the waiting commands of a connection that ended, and return them; what runs continues."""
        return self.scheduler.leave(owner)

    def close(self) -> None:
        """Let the threads exit once they have computed their commands."""
        for _ in self._threads:
            self._to_compute.put(None)

    def _start(self) -> None:
        """Start the commands that may run."""
        while (queued := self._next(self._monotonic())) is not None:
            self._run(queued)

    def _next(self, now: float) -> QueuedCommand | None:
        """Return the next command, which runs from now on; refuse those before it that waited too long."""
        queued, refusals = self.scheduler.start(now)
        self._refuse(refusals, now)
        return queued

    def _run(self, queued: QueuedCommand) -> None:
        """Compute *queued* in the next free thread."""
        if not self._threads:
            self._threads = [
                threading.Thread(target=self._work, name=f"solver-{number}", daemon=True)
                for number in range(self._thread_count)
            ]
            for thread in self._threads:
                thread.start()
        self._to_compute.put(queued)

    def _work(self) -> None:
        while (queued := self._to_compute.get()) is not None:
            self._loop.call_soon_threadsafe(self._on_computed, queued, self._compute(queued))

    def _on_computed(self, queued: QueuedCommand, answer: Answer) -> None:
        self._finish(queued, answer, self._monotonic())
        self._start()

    def _finish(self, queued: QueuedCommand, answer: Answer, now: float) -> None:
        self.scheduler.done(queued, now)
        self._send(answer, now)

    def _refuse(self, refusals: Iterable[RefusedCommand], now: float) -> None:
        for refusal in refusals:
            self._send_refusal(refusal, now)
