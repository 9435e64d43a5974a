"""The queue of long services: a job for each different request, and the commands that wait for its result.

A job is identified by its robot and the digest of its request, so that two equal requests of a robot wait for
the same job.  A job continues when the connection of its robot is closed, and the robot gets the result when
it connects again and repeats the request.  Nothing here blocks the event loop, and progress is sent at most
twice a second.
"""

from __future__ import annotations

import hashlib
import json
import threading
import time
from asyncio import AbstractEventLoop, TimerHandle
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, Busy, Cancelled, RsePfError
from rse_pf.identity import RobotId
from rse_pf.limits.fair_queue import largest_holder
from rse_pf.server.jobs.lease import job_key
from rse_pf.server.jobs.process import JobRequest
from rse_pf.server.jobs.record_gc import RECORD_TTL_S, RecordCollector
from rse_pf.server.jobs.runner import WAITING, JobContext, JobOutcome, JobSignals, run_job
from rse_pf.server.scheduling.command_queue import CommandQueue, QueueBacklog, QueuedCommand, QueueReport
from rse_pf.server.worker_context import Log
from rse_pf.service import failure_of
from rse_pf.wire import Failure, Progress, Result
from rse_pf.wire.arrays import extension_hook

__all__ = ["JobManager"]

MAX_WAITING_JOBS = 8  # jobs of a worker beyond those that may run: with more, a robot would wait for minutes
_PROGRESS_INTERVAL_S = 0.5  # shortest time in seconds between two progress messages for one command
_BUSY_RETRY_MS = 5000.0  # milliseconds until a refused job may be sent again: jobs take seconds to minutes
_CLOSE_TIMEOUT_S = 1.0  # seconds that an exiting worker waits until the jobs that it gives up are recorded so


@dataclass(eq=False, slots=True)
class _Waiter:
    """A command that waits for the result of a job."""

    queued: QueuedCommand
    last_progress_s: float = float("-inf")
    is_progress_due: bool = False


@dataclass(eq=False, slots=True)
class _Entry:
    """A job, and the commands that wait for its result; ``done`` (0..1) and ``what`` are its progress."""

    request: JobRequest
    signals: JobSignals
    waiters: list[_Waiter] = field(default_factory=list)
    resubmitted: list[QueuedCommand] = field(default_factory=list)
    """Commands with the same request that came while the job was being cancelled or given up; they are
    submitted again after its end."""
    done: float = 0.0
    what: str = WAITING
    thread: threading.Thread | None = None
    progress_timer: TimerHandle | None = None


class JobManager(CommandQueue):
    """The jobs for which robots of one worker wait; another worker or server may run them."""

    def __init__(
        self,
        context: JobContext,
        *,
        loop: AbstractEventLoop,
        log: Log,
        answer: Callable[[QueuedCommand, Result | Failure], None],
        progress: Callable[[Any, Progress], None],
        owner: str,
    ) -> None:
        """Start nothing yet.

        Args:
            context: Store, slots, processes and settings of the worker.
            loop: The event loop of the worker.
            log: The log of the worker.
            answer: Called exactly once for each submitted command whose robot stays connected, unless the
                server drains before the job has ended.
            progress: Called with the connection of a command, and the progress of its job.
            owner: Name of this worker in the records of jobs, unique among the workers of all servers.
        """
        self._context = context
        self._max_jobs = context.settings.serving.max_running_jobs + MAX_WAITING_JOBS
        self._loop = loop
        self._log = log
        self._answer = answer
        self._progress = progress
        self._owner = owner
        self._entries: dict[tuple[RobotId, str], _Entry] = {}
        self._cpu_s: defaultdict[str, float] = defaultdict(float)
        self._leaving = False
        self._collector = RecordCollector(
            context.store,
            ttl_s=RECORD_TTL_S,
            clock=context.clock,
            wall_clock=time.time,
        )
        self._settings_digest = _settings_digest(context.settings)

    held = 0
    """Number of commands that must be answered before the worker exits: 0, because other servers continue
    these jobs when robots send the requests again."""

    def offers(self, service: str) -> bool:
        """Return whether *service* is a long service of this server."""
        return service in self._context.services

    def submit(self, queued: QueuedCommand, now: float) -> None:
        """Let *queued* wait for the job of its request, and start the job unless it has an entry already.

        The command is refused if too many jobs wait.  While the server drains, it is ignored: the robot sends
        it again to another server.
        """
        if self._leaving:
            return
        command, claims = queued.command, queued.owner.claims
        try:
            key = job_key(command.service, command.payload, self._settings_digest)
        except BadRequest as error:
            self._fail(queued, error)
            return
        name = (queued.robot, key)
        entry = self._entries.get(name)
        if entry is not None and (entry.signals.cancelled or entry.signals.giving_up):
            entry.resubmitted.append(queued)
            return
        if entry is None:
            request = JobRequest(
                service=command.service,
                payload=command.payload,
                robot=queued.robot,
                key=key,
                quota_bytes=None if claims is None else claims.quota("data_bytes"),
                trace=command.trace,
            )
            if not self._has_capacity(request):
                self._fail(queued, self._too_many_error())
                return
            entry = self._entries[name] = _Entry(request, JobSignals())
            self._begin(entry)
        waiter = _Waiter(queued)
        entry.waiters.append(waiter)
        self._send_progress(entry, waiter)

    def backlog(self, queued: QueuedCommand) -> QueueBacklog:
        """Return how many commands to long services, of the robot of *queued*, have no answer yet."""
        entries = [entry for entry in self._entries.values() if entry.request.robot == queued.robot]
        return QueueBacklog(sum(len(entry.waiters) + len(entry.resubmitted) for entry in entries))

    def withdraw(self, owner: Any, command_id: int) -> None:
        """Cancel the command *command_id* of the connection *owner*.

        If no other command waits for its job, the job is cancelled, and the command is answered after that.
        """
        for entry in list(self._entries.values()):
            for waiter in list(entry.waiters):
                if waiter.queued.owner is owner and waiter.queued.command.id == command_id:
                    if len(entry.waiters) == 1:
                        entry.signals.cancel()
                        return
                    entry.waiters.remove(waiter)
                    self._fail(waiter.queued, Cancelled("the robot cancelled the command"))
                    return

    def leave(self, owner: Any) -> list[QueuedCommand]:
        """Forget the commands of the closed connection *owner*, and return none; their jobs continue."""
        for entry in self._entries.values():
            entry.waiters = [waiter for waiter in entry.waiters if waiter.queued.owner is not owner]
            entry.resubmitted = [queued for queued in entry.resubmitted if queued.owner is not owner]
        return []

    def give_up(self) -> None:
        """Stop all jobs, so that other servers can run them, and ignore further commands."""
        self._leaving = True
        for entry in self._entries.values():
            entry.signals.give_up()

    def close(self) -> None:
        """Give up all jobs, and wait at most `_CLOSE_TIMEOUT_S` until this is in their records."""
        self.give_up()
        until = self._context.clock() + _CLOSE_TIMEOUT_S
        for entry in list(self._entries.values()):
            if entry.thread is not None:
                entry.thread.join(max(0.0, until - self._context.clock()))

    def _has_capacity(self, request: JobRequest) -> bool:
        """Return whether the job of *request* may be added.

        If the worker has its greatest number of jobs, the newest waiting job of a robot with more jobs is
        given up, and its commands are refused as busy (`largest_holder`).  Without such a job the result is
        False.
        """
        here = [entry for entry in self._entries.values() if not entry.signals.giving_up]
        if len(here) < self._max_jobs:
            return True
        newest = {entry.request.robot: entry for entry in here if entry.what == WAITING}
        held = Counter(entry.request.robot for entry in here)
        donor = largest_holder(held, request.robot, newest.__contains__)
        if donor is None:
            return False
        displaced = newest[donor]
        displaced.signals.give_up()
        waiters, displaced.waiters = displaced.waiters, []
        for waiter in waiters:
            self._fail(waiter.queued, self._too_many_error())
        return True

    def _begin(self, entry: _Entry) -> None:
        """Run the job of *entry* in a new thread, which then collects old records of jobs."""

        def work() -> None:
            in_loop = self._loop.call_soon_threadsafe

            def report(done: float, what: str) -> None:
                in_loop(self._on_progress, entry, done, what)

            try:
                outcome = run_job(entry.request, self._context, entry.signals, report, self._owner)
            except Exception as error:  # noqa: BLE001  after a defect the robot must get an answer, too
                self._log.error("job-defect", service=entry.request.service, reason=repr(error))
                hint = "see job-defect in the server's log"
                outcome = JobOutcome(error=RsePfError("the job failed", hint=hint))
            in_loop(self._on_outcome, entry, outcome)
            if not outcome.is_given_up:
                self._collector.collect()

        entry.thread = threading.Thread(target=work, name=f"job-{entry.request.key[:8]}", daemon=True)
        entry.thread.start()

    def report(self) -> QueueReport:
        """Return the number of this worker's jobs, of those that wait for a slot, and CPU seconds by tenant.

        The CPU seconds are those of jobs that this worker has run and that have ended.
        """
        pending = sum(entry.what == WAITING for entry in self._entries.values())
        return QueueReport(
            gauges={"jobs": float(len(self._entries)), "jobs_pending": float(pending)},
            cpu_s={"jobs": dict(self._cpu_s)},
        )

    def _on_progress(self, entry: _Entry, done: float, what: str) -> None:
        entry.done, entry.what = done, what
        for waiter in entry.waiters:
            self._send_progress(entry, waiter)

    def _send_progress(self, entry: _Entry, waiter: _Waiter) -> None:
        """Send the progress of *entry* to one command, now or when `_PROGRESS_INTERVAL_S` has passed."""
        now = self._context.clock()
        wait_s = waiter.last_progress_s + _PROGRESS_INTERVAL_S - now
        if wait_s <= 0:
            waiter.last_progress_s = now
            progress = Progress(id=waiter.queued.command.id, done=entry.done, what=entry.what)
            self._progress(waiter.queued.owner, progress)
        elif not waiter.is_progress_due:
            waiter.is_progress_due = True
            if entry.progress_timer is None:
                entry.progress_timer = self._loop.call_later(wait_s, self._send_due_progress, entry)

    def _send_due_progress(self, entry: _Entry) -> None:
        entry.progress_timer = None
        for waiter in entry.waiters:
            if waiter.is_progress_due:
                waiter.is_progress_due = False
                self._send_progress(entry, waiter)

    def _on_outcome(self, entry: _Entry, outcome: JobOutcome) -> None:
        """Remove the job, answer the commands that wait for it, and submit the resubmitted ones.

        A job that was given up is not answered.
        """
        request = entry.request
        self._cpu_s[request.robot.tenant] += outcome.cpu_s
        del self._entries[request.robot, request.key]
        waiters, entry.waiters = entry.waiters, []
        entry.signals.close()
        if entry.progress_timer is not None:
            entry.progress_timer.cancel()
        code = "given-up" if outcome.is_given_up else "ok" if outcome.error is None else outcome.error.code
        self._log.info(
            "job", robot=request.robot, service=request.service, job=request.key[:16], code=code,
            object=outcome.object[:16], compute_ms=round(outcome.compute_ms, 3), trace=request.trace,
            cpu_s=round(outcome.cpu_s, 3),
        )  # fmt: skip
        reply = None
        if outcome.reply is not None:
            reply = msgspec.msgpack.decode(outcome.reply, ext_hook=extension_hook)
        for waiter in () if outcome.is_given_up else waiters:
            if outcome.error is not None:
                self._fail(waiter.queued, outcome.error)
                continue
            result = Result(
                id=waiter.queued.command.id, reply=reply, server=self._context.server_id,
                compute_ms=outcome.compute_ms, object=outcome.object,
            )  # fmt: skip
            self._answer(waiter.queued, result)
        for queued in entry.resubmitted:
            self.submit(queued, self._context.clock())

    def _too_many_error(self) -> Busy:
        return Busy(
            f"this worker of the server has {self._max_jobs} jobs that run or wait, and accepts no more",
            hint="send the command again after retry_after_ms",
            retry_after_ms=_BUSY_RETRY_MS,
        )

    def _fail(self, queued: QueuedCommand, error: RsePfError) -> None:
        self._answer(queued, failure_of(error, queued.command, server=self._context.server_id))


def _settings_digest(settings: PlatformSettings) -> str:
    """Return the sha256 of the settings on which the result of a job depends; it is part of the job's key."""
    plain = settings.to_dict()
    chosen = json.dumps([plain["services"], plain["pnp"]], sort_keys=True)
    return hashlib.sha256(chosen.encode()).hexdigest()
