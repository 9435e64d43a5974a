"""The two queues of the services that a worker computes itself: stateless services, and limited services.

In each queue a `Scheduler` decides the order, and threads compute the commands; all else runs in the event
loop.  Limited services, such as those that read maps, have a queue of their own, so that no pose waits for a
map.
"""

from __future__ import annotations

import threading
from asyncio import TimerHandle
from collections.abc import Callable, Iterable
from queue import SimpleQueue

from rse_pf.server.compute.limited_services import LimitedServices
from rse_pf.server.gateway.admission import is_in_scope
from rse_pf.server.gateway.answers import Answers, EncodedAnswer
from rse_pf.server.metrics import LongestRecently
from rse_pf.server.scheduling.command_queue import (
    CommandQueue,
    QueueBacklog,
    QueuedCommand,
    QueueReport,
    RefusedCommand,
)
from rse_pf.server.scheduling.cpu_throttle import CpuThrottle
from rse_pf.server.scheduling.scheduler import INLINE_BYTES, Scheduler
from rse_pf.server.worker_context import WorkerContext
from rse_pf.service import Service

__all__ = ["LimitedQueue", "StatelessQueue", "ThreadQueue"]

_SOLVER_THREADS = 1  # of a worker, for stateless services: a second one would wait for the interpreter lock
# Seconds of one round of the event loop after which it computes no further command.  With longer rounds
# sockets are read too rarely, and commands wait in the kernel, where the scheduler cannot count them.
_INLINE_S = 0.001
# If commands wait, and all readable sockets were read, the limit is instead this share of the time since the
# last round ended, at least `_INLINE_S` and at most `_MAX_INLINE_S`.
_INLINE_SHARE = 0.5
_MAX_INLINE_S = 0.005  # greatest limit in seconds, so that timers and control messages are not delayed more
# Seconds that count for a command which took 0 s by the clock: after a command, a round's time is never 0.
_MIN_INLINE_S = 1e-6


class ThreadQueue(CommandQueue):
    """A queue whose commands run in threads; the base of the two queues of this module."""

    def __init__(
        self, context: WorkerContext, answers: Answers, services: Iterable[Service], *, threads: int
    ) -> None:
        """Compute nothing yet; the threads start with the first command that needs them.

        Args:
            context: The clocks and the event loop of the worker.
            answers: Computes, encodes and sends answers.
            services: The services that this queue offers.
            threads: Number of threads, and so of commands that run at the same time.
        """
        self.scheduler = Scheduler(max_running=threads)
        self._names = frozenset(service.name for service in services)
        self._answers = answers
        self._loop = context.loop
        self._monotonic = context.clocks.monotonic
        self._thread_count = threads
        self._threads: list[threading.Thread] = []
        self._to_compute: SimpleQueue[QueuedCommand | None] = SimpleQueue()

    @property
    def held(self) -> int:
        """Number of commands that wait or run."""
        return self.scheduler.waiting + self.scheduler.running

    def offers(self, service: str) -> bool:
        """Return whether this queue takes commands to *service*."""
        return service in self._names

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return the load that decides whether *queued* is admitted, see `Scheduler.backlog`."""
        return self.scheduler.backlog(queued)

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, which was admitted at *now* (s), and start as many commands as may run.

        A frame of the same stream that it replaces is answered as stale.
        """
        self._refuse(self.scheduler.submit(queued), now)
        self._start()

    def withdraw(self, owner: object, command_id: int) -> None:
        """Ignore that the robot cancelled a command: it is computed, and answered as usual."""

    def leave(self, owner: object) -> list[QueuedCommand]:
        """Drop the waiting commands of a closed connection, and return them; a running one continues."""
        return self.scheduler.leave(owner)

    def close(self) -> None:
        """Let the threads exit once they have computed their commands."""
        for _ in self._threads:
            self._to_compute.put(None)

    def compute(self, queued: QueuedCommand) -> EncodedAnswer:
        """Return the answer to *queued*; runs in a thread, and never raises."""
        raise NotImplementedError

    def _start(self) -> None:
        """Start as many waiting commands as may run now."""
        while (queued := self._next(self._monotonic())) is not None:
            self._run(queued)

    def _next(self, now: float) -> QueuedCommand | None:
        """Return the next command, which counts as running at *now* (s); None if none may run.

        Commands before it whose deadline has passed, or that have waited for too long, are refused.
        """
        queued, refusals = self.scheduler.start(now)
        if refusals:
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
            self._loop.call_soon_threadsafe(self._on_computed, self.compute(queued))

    def _on_computed(self, answer: EncodedAnswer) -> None:
        self._finish(answer, self._monotonic())
        self._start()

    def _finish(self, answer: EncodedAnswer, now: float) -> None:
        self.scheduler.done(answer.queued, now)
        self._answers.send(answer, now)

    def _refuse(self, refusals: Iterable[RefusedCommand], now: float) -> None:
        for refusal in refusals:
            self._answers.send_refusal(refusal, now)


class LimitedQueue(ThreadQueue):
    """The queue of limited services: a thread passes each command to a limited process and waits for it."""

    def __init__(self, context: WorkerContext, answers: Answers, limited: LimitedServices) -> None:
        """Compute nothing yet; *limited* computes the commands in its processes."""
        services = [service for service in answers.registry if service.limited]
        super().__init__(context, answers, services, threads=1)  # a worker has one process with limits
        self._limited = limited

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, or refuse it while its robot is blocked after crashes."""
        refusal = self._limited.refusal(queued, now)
        if refusal is not None:
            self._refuse([RefusedCommand(queued, refusal, "blocked")], now)
        else:
            super().submit(queued, now)

    def compute(self, queued: QueuedCommand) -> EncodedAnswer:
        """Return the answer to *queued*, computed in a process; blocks until its deadline at most."""
        started_s = self._monotonic()
        return self._answers.encode(queued, self._limited.compute(queued), started_s)

    def report(self) -> QueueReport:
        """Return the gauges ``compute_*`` of limited services for /metrics."""
        return QueueReport(
            gauges={
                "compute_queue": float(self.scheduler.waiting),
                "compute_running": float(self.scheduler.running),
                "compute_cpu_s": self._limited.cpu_s(),
                "compute_blocked_robots": float(self._limited.blocked_robots(self._monotonic())),
            }
        )

    def close(self) -> None:
        """Let the threads exit, and kill the limited processes at once."""
        super().close()
        self._limited.close()


class StatelessQueue(ThreadQueue):
    """The queue of stateless services; the event loop computes cheap commands where that saves time.

    1. If no command waits or runs, a cheap command is computed in the event loop at once (`runs_at_once`).
    2. Otherwise a command is queued, and the `Scheduler` decides the order.
    3. A queued command is computed in the event loop if its service is cheap and a thread would save no time
       (`Scheduler.runs_inline`), or else in the solver thread.
    4. In one round of the event loop, commands are computed for a bounded time (`_INLINE_S`,
       `_INLINE_SHARE`).
    """

    def __init__(self, context: WorkerContext, answers: Answers) -> None:
        """Compute nothing yet."""
        clocks = context.clocks
        services = [
            service for service in answers.registry if service.kind == "stateless" and not service.limited
        ]
        super().__init__(context, answers, services, threads=_SOLVER_THREADS)
        self._crash = context.crash
        self._cheap = frozenset(
            service.name for service in services if service.cheap and service.name not in answers.with_objects
        )
        """Names of the services that `runs_at_once` may call: they are cheap, and read no stored objects."""
        self._throttle = CpuThrottle(
            context.settings.serving.emulated_cores, now=clocks.monotonic(), cpu=clocks.cpu
        )
        self._throttle_timer: TimerHandle | None = None
        self._waits = LongestRecently()
        self._inline_s = 0.0
        """Seconds that commands have taken in this round of the event loop."""
        self._max_inline_s = _INLINE_S
        self._round_ended_s = 0.0
        self.leaves_unread: Callable[[], bool] = lambda: False
        """Returns whether the event loop left readable sockets unread in its last round."""

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Queue *queued*, which was admitted at *now* (s), and start as many commands as may run."""
        self._crash.compute_for(0)  # commands of other robots may start, too: `Answers.compute` marks them
        super().submit(queued, now)

    def compute(self, queued: QueuedCommand) -> EncodedAnswer:
        """Return the answer to *queued*, computed in the calling thread."""
        return self._answers.compute(queued)

    def report(self) -> QueueReport:
        """Return the gauges of stateless services for /metrics: waiting and running commands, and waits."""
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
        """Compute and answer *queued* in the event loop without queueing it, and return True.

        Return False and do nothing if *queued* is not cheap, small and within the scope of its token, if
        other commands wait or run, if this round of the event loop has no time left, or if the CPU is
        throttled.  The caller then admits and queues the command as usual.
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

    def _note_inline(self, spent_s: float) -> None:
        """Add *spent_s* to the time that commands have taken in this round of the event loop."""
        if not self._inline_s:
            self._loop.call_soon(self._begin_round)
        self._inline_s += spent_s or _MIN_INLINE_S

    def _start(self) -> None:
        """Start waiting commands until none may run, this round's time is used, or the CPU is throttled."""
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
        """Compute the answer to *queued* in the event loop, if that saves time, else in a solver thread."""
        command, answers = queued.command, self._answers
        service = answers.registry.get(command.service)
        asks_store = command.service in answers.with_objects and answers.objects.has_references(
            command, service
        )
        if not asks_store and self.scheduler.runs_inline(cheap=service.cheap, size_bytes=queued.size_bytes):
            answer = answers.compute(queued)
            self._finish(answer, ended := self._monotonic())
            self._note_inline(ended - queued.started_s)
        else:
            super()._run(queued)

    def _begin_round(self) -> None:
        """Begin a round of the event loop: set the limit of its time for commands, and start commands."""
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
