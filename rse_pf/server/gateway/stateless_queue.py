"""The queue of stateless services: its commands are computed in the event loop or in a solver thread.

A cheap command of an idle server is computed in the event loop at once (`StatelessQueue.runs_at_once`).  All
others wait in the order of the `Scheduler`, and cheap ones among them are computed in the event loop, too, as
long as a thread would save no time.
"""

from __future__ import annotations

from asyncio import TimerHandle
from collections.abc import Callable

from rse_pf.server.gateway.admission import is_in_scope
from rse_pf.server.gateway.answers import Answers, EncodedAnswer
from rse_pf.server.metrics import LongestRecently
from rse_pf.server.ports import WorkerContext
from rse_pf.server.scheduling.command_queue import QueuedCommand, QueueReport
from rse_pf.server.scheduling.cpu_throttle import CpuThrottle
from rse_pf.server.scheduling.scheduler import INLINE_BYTES
from rse_pf.server.scheduling.thread_queue import ThreadQueue

__all__ = ["StatelessQueue"]

_SOLVER_THREADS = 1  # of each worker: a second one would wait for the interpreter lock
# Time for commands in one round of the event loop.  With longer rounds sockets are read too rarely, and
# commands wait in the kernel, where the scheduler cannot count them.
_INLINE_S = 0.001
# Share of the time since the last round that commands may take where commands wait and no socket is unread.
_INLINE_SHARE = 0.5
_MAX_INLINE_S = 0.005  # bound of that share, so that timers and control messages wait no longer
_MIN_INLINE_S = 1e-6  # counted for a command that took no time by the clock, so that the round counts as used


class StatelessQueue(ThreadQueue[EncodedAnswer]):
    """Commands of stateless services that wait or run."""

    def __init__(self, context: WorkerContext, answers: Answers) -> None:
        """Compute nothing yet.

        Args:
            context: The settings, clocks and event loop of the worker.
            answers: Computes and sends answers; its registry names the services.
        """
        clocks = context.clocks
        services = [
            service for service in answers.registry if service.kind == "stateless" and not service.limited
        ]
        super().__init__(
            (service.name for service in services), threads=_SOLVER_THREADS, loop=context.loop,
            monotonic=clocks.monotonic, compute=answers.compute, send=answers.send,
            send_refusal=answers.send_refusal,
        )  # fmt: skip
        self._answers = answers
        self._crash = context.crash
        self._cheap = frozenset(
            service.name for service in services if service.cheap and service.name not in answers.with_objects
        )
        """Services that `runs_at_once` may run: in the event loop, without asking a store before."""
        self._throttle = CpuThrottle(
            context.settings.serving.emulated_cores, now=clocks.monotonic(), cpu=clocks.cpu
        )
        self._throttle_timer: TimerHandle | None = None
        self._waits = LongestRecently()
        self._inline_s = 0.0
        """Time that commands took in this round of the event loop."""
        self._max_inline_s = _INLINE_S
        self._round_ended_s = 0.0
        self.leaves_unread: Callable[[], bool] = lambda: False
        """Returns whether there was no time for some of the sockets when they were read last."""

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, which was admitted at *now* (s), and start the commands that may run."""
        self._crash.compute_for(0)  # commands of other robots may start, too; `Answers.compute` marks each
        super().submit(queued, now)

    def report(self) -> QueueReport:
        """Return gauges for /metrics."""
        now = self._monotonic()
        oldest_wait_s = self.scheduler.oldest_wait_s(now)
        return QueueReport(
            gauges={
                "queue": float(self.scheduler.waiting),
                "queue_oldest_s": oldest_wait_s,
                "queue_ms": max(self._waits.longest_s(now), oldest_wait_s) * 1e3,
                "in_flight": float(self.scheduler.running),
            }
        )

    def runs_at_once(self, queued: QueuedCommand) -> bool:
        """Answer a cheap command of an idle server without queueing it; False if it has to be queued or
        refused.

        This decides, counts and answers as `submit` does.
        """
        service = queued.command.service
        claims = queued.owner.claims
        if (
            self._inline_s >= self._max_inline_s
            or service not in self._cheap
            or queued.size_bytes > INLINE_BYTES
            or self._throttle.is_on
            or (claims is not None and not is_in_scope(service, claims))
        ):
            return False
        now = self._monotonic()
        if not self.scheduler.start_unqueued(queued, now):
            return False
        self._waits.note(now - queued.received_s, now)
        answer = self._answers.compute(queued)
        self.scheduler.finish_unqueued(queued, ended := self._monotonic())
        self._note_inline(ended - now)
        self._answers.send(answer, ended)
        return True

    # --- from the queue to an answer -----------------------------------------------------------

    def _note_inline(self, spent_s: float) -> None:
        """Note that a command took *spent_s* of this round of the event loop."""
        if not self._inline_s:
            self._loop.call_soon(self._begin_round)
        self._inline_s += spent_s or _MIN_INLINE_S

    def _start(self) -> None:
        """Start the commands that may run, as long as this round of the event loop and the throttle allow."""
        while self._inline_s < self._max_inline_s and self.scheduler.waiting:
            now = self._monotonic()
            wait_s = self._throttle.wait_s(now)
            if wait_s > 0:
                if self._throttle_timer is None:
                    self._throttle_timer = self._loop.call_later(wait_s, self._end_throttle)
                return
            queued = self._next(now)
            if queued is None:
                return
            self._waits.note(now - queued.received_s, now)
            self._run(queued)

    def _run(self, queued: QueuedCommand) -> None:
        """Compute the answer to *queued*, in the event loop or in a solver thread."""
        command, answers = queued.command, self._answers
        service = answers.registry.get(command.service)
        asks_store = command.service in answers.with_objects and answers.objects.has_references(
            command, service
        )
        if not asks_store and self.scheduler.runs_inline(cheap=service.cheap, size_bytes=queued.size_bytes):
            answer = answers.compute(queued)
            self._finish(queued, answer, ended := self._monotonic())
            self._note_inline(ended - queued.started_s)
        else:
            super()._run(queued)

    # --- timers --------------------------------------------------------------------------------

    def _begin_round(self) -> None:
        """Begin a round of the event loop; if no socket was left unread, commands may take more of it."""
        self._inline_s, self._max_inline_s = 0.0, _INLINE_S
        if self.scheduler.waiting:
            if not self.leaves_unread():
                since_s = self._monotonic() - self._round_ended_s
                self._max_inline_s = max(_INLINE_S, min(_MAX_INLINE_S, _INLINE_SHARE * since_s))
            self._start()
        self._round_ended_s = self._monotonic()

    def _end_throttle(self) -> None:
        self._throttle_timer = None
        self._start()
