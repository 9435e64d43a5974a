"""The queue of limited services, separate from that of other services, so that no pose waits for a map."""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable, Iterable
from typing import TypeVar

from rse_pf.server.compute.limited_services import LimitedServices
from rse_pf.server.scheduling.command_queue import QueuedCommand, QueueReport, RefusedCommand
from rse_pf.server.scheduling.thread_queue import ThreadQueue
from rse_pf.wire import Failure, Result

__all__ = ["ComputeLane"]

Answer = TypeVar("Answer")


class ComputeLane(ThreadQueue[Answer]):
    """Commands of limited services; each thread waits for one process."""

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
        """Compute nothing yet; see `ThreadQueue` for the arguments that are not named here.

        Args:
            names: Names of the limited services.
            limited: Computes their commands.
            threads: As many as there are processes.
            loop: Event loop of the worker.
            monotonic: Its clock, in seconds.
            encode: Makes an answer in a thread, from the time at which the computation began.
            send: Sends an answer.
            send_refusal: Answers a command that is not computed.
        """

        def compute(queued: QueuedCommand) -> Answer:
            started_s = monotonic()
            return encode(queued, limited.compute(queued), started_s)

        super().__init__(
            names, threads=threads, loop=loop, monotonic=monotonic, compute=compute, send=send,
            send_refusal=send_refusal,
        )  # fmt: skip
        self._limited = limited

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, or refuse it while its robot is blocked after crashes."""
        refusal = self._limited.refusal(queued, now)
        if refusal is not None:
            self._send_refusal(RefusedCommand(queued, refusal, "blocked"), now)
        else:
            super().submit(queued, now)

    def report(self) -> QueueReport:
        """Return gauges for /metrics."""
        return QueueReport(
            gauges={
                "compute_queue": float(self.scheduler.waiting),
                "compute_running": float(self.scheduler.running),
                "compute_cpu_s": self._limited.cpu_s(),
                "compute_blocked_robots": float(self._limited.blocked_robots(self._monotonic())),
            }
        )

    def close(self) -> None:
        """Let the threads exit, and end the processes at once."""
        super().close()
        self._limited.close()
