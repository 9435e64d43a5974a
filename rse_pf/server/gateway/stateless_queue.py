"""The queue of stateless services: its commands are computed in the event loop or in a solver thread.

Nothing but the computation of an answer (`Answers.compute`) runs outside of the event loop.
"""

from __future__ import annotations

from asyncio import TimerHandle
from collections.abc import Callable

from rse_pf.server.gateway.admission import is_in_scope
from rse_pf.server.gateway.answers import Answers, EncodedAnswer
from rse_pf.server.metrics import LongestRecently
from rse_pf.server.ports import WorkerContext
from rse_pf.server.scheduling.command_queue import CommandQueue, QueueReport
from rse_pf.server.scheduling.cpu_throttle import CpuThrottle
from rse_pf.server.scheduling.scheduler import (
    INLINE_BYTES,
    QueueBacklog,
    QueuedCommand,
    RefusedCommand,
    Scheduler,
)
from rse_pf.server.scheduling.thread_pool import SOLVER_THREADS, SolverThreads

__all__ = ["StatelessQueue"]

_INLINE_S, _LONGEST_INLINE_S, _INLINE_SHARE = 0.001, 0.005, 0.5
"""Commands are computed in the event loop for so long in one of its rounds, so that sockets are read again: a
longer round would hide the queue in the kernel, where its length cannot be seen.  Where commands wait and no
socket was left unread, they are for `_INLINE_SHARE` of the time since they last were, up to
`_LONGEST_INLINE_S`."""
_LEAST_S = 1e-6
"""What a command counts as that took no time by the clock."""


class StatelessQueue(CommandQueue):
    """Commands of stateless services that wait or run."""

    def __init__(self, context: WorkerContext, answers: Answers) -> None:
        """Compute nothing yet; the solver threads start with the first command that needs them.

        Args:
            context: The settings, clocks and event loop of the worker.
            answers: Computes and sends answers; its registry names the services.
        """
        clocks, loop = context.clocks, context.loop
        self.scheduler = Scheduler()
        self._answers = answers
        self._crash = context.crash
        self._registry = answers.registry
        services = [
            service for service in self._registry if service.kind == "stateless" and not service.limited
        ]
        self._names = frozenset(service.name for service in services)
        self._cheap = frozenset(
            service.name for service in services if service.cheap and service.name not in answers.with_objects
        )
        """Services that `runs_at_once` may run: in the event loop, without asking a store before."""
        self._loop = loop
        self._monotonic = clocks.monotonic
        self._throttle = CpuThrottle(
            context.settings.serving.emulated_cores, now=clocks.monotonic(), cpu=clocks.cpu
        )
        self._threads = SolverThreads(
            SOLVER_THREADS,
            answers.compute,
            lambda answer: loop.call_soon_threadsafe(self._on_computed, answer),
        )
        self._waits = LongestRecently()
        self._inline_s = 0.0
        """Time that commands took in the event loop in this round of it."""
        self._most_inline_s, self._round_ended_s = _INLINE_S, 0.0
        self.leaves_unread: Callable[[], bool] = lambda: False
        """Whether there was no time for some of the sockets when they were read last."""
        self._throttle_timer: TimerHandle | None = None

    @property
    def held(self) -> int:
        """Commands that wait or run."""
        return self.scheduler.waiting + self.scheduler.running

    def offers(self, service: str) -> bool:
        """Return whether *service* is a stateless one that runs in this process."""
        return service in self._names

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return what would delay *queued*, see `Scheduler.backlog`."""
        return self.scheduler.backlog(queued)

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, which was admitted, and start the commands whose turn it is."""
        self._crash.compute_for(0)  # answers to other robots are sent, too; `Answers.compute` marks its own
        self._refuse(self.scheduler.submit(queued), now)
        self._start()

    def withdraw(self, owner: object, command_id: int) -> None:
        """Do nothing: the command is answered soon in any case."""

    def leave(self, owner: object) -> list[QueuedCommand]:
        """Drop the waiting commands of a connection that ended, and return them; what runs goes on."""
        return self.scheduler.leave(owner)

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

    def close(self) -> None:
        """End the threads when they have nothing left."""
        self._threads.close()

    def runs_at_once(self, queued: QueuedCommand) -> bool:
        """Answer a cheap command of an idle server without a place in the queue; False if it has to be
        queued or refused.

        The shortest way of a command.  It decides, counts and answers as `submit` does for any other.
        """
        service = queued.command.service
        claims = queued.owner.claims
        if (
            self._inline_s >= self._most_inline_s
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
            self._loop.call_soon(self._next_round)
        self._inline_s += spent_s or _LEAST_S

    def _start(self) -> None:
        """Start the commands whose turn it is, as many as threads and the throttle allow."""
        scheduler = self.scheduler
        while (
            self._inline_s < self._most_inline_s and scheduler.waiting and scheduler.running < SOLVER_THREADS
        ):
            now = self._monotonic()
            wait_s = self._throttle.wait_s(now)
            if wait_s > 0:
                if self._throttle_timer is None:
                    self._throttle_timer = self._loop.call_later(wait_s, self._go_on)
                break
            queued, refusals = scheduler.start(now)
            if refusals:
                self._refuse(refusals, now)
            if queued is not None:
                self._waits.note(now - queued.received_s, now)
                self._run(queued)

    def _run(self, queued: QueuedCommand) -> None:
        """Compute the answer to *queued*, in the event loop or in a solver thread."""
        command = queued.command
        answers = self._answers
        service = self._registry.get(command.service)
        may_refer = command.service in answers.with_objects
        asks_store = may_refer and answers.objects.has_references(command, service)
        if not asks_store and self.scheduler.runs_inline(cheap=service.cheap, size_bytes=queued.size_bytes):
            answer = answers.compute(queued)
            self._finish(answer, ended := self._monotonic())
            self._note_inline(ended - queued.started_s)
        else:
            self._threads.run(queued)

    def _on_computed(self, answer: EncodedAnswer) -> None:
        self._finish(answer, self._monotonic())
        self._start()

    def _finish(self, answer: EncodedAnswer, now: float) -> None:
        self.scheduler.done(answer.queued, now)
        self._answers.send(answer, now)

    def _refuse(self, refusals: list[RefusedCommand], now: float) -> None:
        for refusal in refusals:
            self._answers.send_refusal(refusal, now)

    # --- timers --------------------------------------------------------------------------------

    def _next_round(self) -> None:
        self._inline_s, self._most_inline_s = 0.0, _INLINE_S
        if self.scheduler.waiting:
            if not self.leaves_unread():
                since_s = self._monotonic() - self._round_ended_s
                self._most_inline_s = max(_INLINE_S, min(_LONGEST_INLINE_S, _INLINE_SHARE * since_s))
            self._start()
        self._round_ended_s = self._monotonic()

    def _go_on(self) -> None:
        self._throttle_timer = None
        self._start()
