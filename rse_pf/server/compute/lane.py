"""The queue of limited services: beside that of the solver threads, so that no pose waits for a map.

It has the same rules as the other queue (`Scheduler`), and as many threads as there are processes.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

from rse_pf.server.compute.limited_services import LimitedServices
from rse_pf.server.scheduling.command_queue import CommandQueue, QueueReport
from rse_pf.server.scheduling.scheduler import (
    QueueBacklog,
    QueuedCommand,
    RefusedCommand,
    Scheduler,
)
from rse_pf.server.scheduling.thread_pool import SolverThreads
from rse_pf.wire import Failure, Result

__all__ = ["ComputeLane"]


Answer = TypeVar("Answer")


class ComputeLane(CommandQueue, Generic[Answer]):
    """Commands of limited services that wait or run."""

    def __init__(
        self,
        names: Iterable[str],
        limited: LimitedServices,
        *,
        threads: int,
        loop: AbstractEventLoop,
        monotonic: Callable[[], float],
        encode: Callable[[QueuedCommand, Result | Failure, float], Answer],
        send: Callable[[Answer, float], None],
        send_refusal: Callable[[RefusedCommand, float], None],
    ) -> None:
        """Compute nothing yet; the threads start with the first command.

        Args:
            names: Names of the limited services.
            limited: Computes their commands.
            threads: Commands that run at the same time.
            loop: Event loop of the worker.
            monotonic: Its clock, s.
            encode: Makes an answer in a thread; gets the time at which the computation began.
            send: Sends an answer in the loop, at a time.
            send_refusal: Answers a command that is given up, at a time.
        """
        self._names = frozenset(names)
        self._limited = limited
        self._scheduler = Scheduler()
        self._count = threads
        self._monotonic = monotonic
        self._encode, self._send, self._send_refusal = encode, send, send_refusal
        self._threads = SolverThreads(
            threads,
            self._compute,
            lambda computed: loop.call_soon_threadsafe(self._on_computed, *computed),
            name="compute",
        )

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        return self._scheduler.waiting + self._scheduler.running

    def offers(self, service: str) -> bool:
        """Return whether *service* is a limited one."""
        return service in self._names

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return what would delay *queued*, see `Scheduler.backlog`."""
        return self._scheduler.backlog(queued)

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, which was admitted, or refuse it while its robot is blocked after crashes."""
        refusal = self._limited.refusal(queued, now)
        if refusal is not None:
            self._send_refusal(RefusedCommand(queued, refusal, "blocked"), now)
            return
        self._refuse_all(self._scheduler.submit(queued), now)
        self._start()

    def withdraw(self, owner: object, command_id: int) -> None:
        """Do nothing: the command is answered before its deadline."""

    def leave(self, owner: object) -> list[QueuedCommand]:
        """Drop the waiting commands of a connection that ended, and return them; what runs goes on."""
        return self._scheduler.leave(owner)

    def report(self) -> QueueReport:
        """Return gauges for /metrics."""
        return QueueReport(
            gauges={
                "compute_queue": float(self._scheduler.waiting),
                "compute_running": float(self._scheduler.running),
                "compute_cpu_s": self._limited.cpu_s(),
                "compute_blocked_robots": float(self._limited.blocked_robots(self._monotonic())),
            }
        )

    def close(self) -> None:
        """End the threads when they have nothing left, and the processes at once."""
        self._threads.close()
        self._limited.close()

    def _start(self) -> None:
        scheduler = self._scheduler
        while scheduler.waiting and scheduler.running < self._count:
            now = self._monotonic()
            queued, refusals = scheduler.start(now)
            self._refuse_all(refusals, now)
            if queued is not None:
                self._threads.run(queued)

    def _compute(self, queued: QueuedCommand) -> tuple[QueuedCommand, Answer]:
        started_s = self._monotonic()
        return queued, self._encode(queued, self._limited.compute(queued), started_s)

    def _on_computed(self, queued: QueuedCommand, answer: Answer) -> None:
        now = self._monotonic()
        self._scheduler.done(queued, now)
        self._send(answer, now)
        self._start()

    def _refuse_all(self, refusals: list[RefusedCommand], now: float) -> None:
        for refusal in refusals:
            self._send_refusal(refusal, now)
