"""Long services as jobs (the worker's side): who waits for which job, what they are told, and how it ends.

A job is named by its robot and the digest of what was asked, so asking again is waiting again.  Promises that
nothing here blocks the event loop, that a robot hears of progress at most twice a second, and that a job
outlives the connection which asked for it.
"""

from __future__ import annotations

import functools
import hashlib
import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.backend.jobs.fair_queue import who_makes_room
from rse_pf.backend.jobs.lease import job_key
from rse_pf.backend.jobs.record_gc import RecordCollector
from rse_pf.backend.jobs.runner import WAITS, JobContext, JobOutcome, JobRequest, JobSignals, run_job
from rse_pf.backend.ports import Log, Loop
from rse_pf.backend.quota import quota_bytes
from rse_pf.backend.scheduling.scheduler import QueuedCommand
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, Busy, Cancelled, RsePfError
from rse_pf.service import failure_of
from rse_pf.wire import Failure, Progress, Result
from rse_pf.wire.arrays import extension_hook

__all__ = ["JobManager"]

_PROGRESS_PAUSE_S = 0.5
_BUSY_RETRY_MS = 5000.0
_CLOSING_S = 1.0


@dataclass(eq=False, slots=True)
class _Waiter:
    job: QueuedCommand
    told_s: float = float("-inf")
    is_told_later: bool = False


@dataclass(eq=False, slots=True)
class _Entry:
    wanted: JobRequest
    signals: JobSignals
    waiters: list[_Waiter] = field(default_factory=list)
    again: list[QueuedCommand] = field(default_factory=list)
    """Asked while the same job was being cancelled, or made room for another robot's."""
    share: float = 0.0
    what: str = WAITS
    thread: threading.Thread | None = None


class JobManager:
    """The jobs that robots of one worker wait for, wherever they run."""

    def __init__(
        self,
        context: JobContext,
        *,
        settings: PlatformSettings,
        loop: Loop,
        log: Log,
        answer: Callable[[QueuedCommand, Result | Failure], None],
        progress: Callable[[Any, Progress], None],
        new_owner: Callable[[], str],
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        """Start nothing yet.

        Args:
            context: Store, turns and processes.
            settings: Of the platform; what a result may depend on is part of a job's name.
            loop: Of the worker.
            log: Of the worker.
            answer: Called exactly once for each submitted command whose connection lives, unless the server
                leaves before the job's end.
            progress: Called with the connection of a command, and how far it is.
            new_owner: Makes names that are unique among all servers.
            wall_clock: Unix seconds.
        """
        self._context = context
        self._serving = settings.serving
        self._loop = loop
        self._log = log
        self._answer = answer
        self._progress = progress
        self._new_owner = new_owner
        self._entries: dict[tuple[str, str, str], _Entry] = {}
        self._leaving = False
        self._sweep = RecordCollector(
            context.store,
            life_s=settings.serving.job_record_ttl_s,
            clock=context.clock,
            wall_clock=wall_clock,
        )
        plain = settings.to_dict()
        chosen = json.dumps([plain["services"], plain["pnp"]], sort_keys=True)
        self._settings_digest = hashlib.sha256(chosen.encode()).hexdigest()

    @property
    def known(self) -> int:
        """Jobs that run here, wait for their turn, or are followed elsewhere."""
        return len(self._entries)

    def submit(self, job: QueuedCommand) -> None:
        """Let the robot wait for its job, which begins unless it runs or is done; the answer comes later.

        While the server leaves nothing is answered: the robot asks again wherever it goes.
        """
        if self._leaving:
            return
        try:
            wanted = self._wanted(job)
        except BadRequest as error:
            self._fail(job, error)
            return
        name = (wanted.tenant, wanted.robot, wanted.key)
        entry = self._entries.get(name)
        if entry is not None and (entry.signals.cancelled or entry.signals.giving_up):
            entry.again.append(job)
            return
        if entry is None:
            if not self._has_room(wanted):
                self._fail(job, _too_many())
                return
            entry = self._entries[name] = _Entry(wanted, JobSignals())
            entry.waiters.append(_Waiter(job))
            self._begin(entry)
        else:
            entry.waiters.append(_Waiter(job))
        self._tell(entry)

    def withdraw(self, connection: Any, identity: int) -> None:
        """Take one command back; the job ends when nobody else waits for it."""
        for entry in list(self._entries.values()):
            for waiter in list(entry.waiters):
                if waiter.job.owner is connection and waiter.job.command.id == identity:
                    if len(entry.waiters) == 1:
                        entry.signals.cancel()
                        return
                    entry.waiters.remove(waiter)
                    self._fail(waiter.job, Cancelled("the robot took the command back"))
                    return

    def left(self, connection: Any) -> None:
        """Forget the commands of a connection that ended; their jobs go on, for the robot comes back."""
        for entry in self._entries.values():
            entry.waiters = [waiter for waiter in entry.waiters if waiter.job.owner is not connection]
            entry.again = [job for job in entry.again if job.owner is not connection]

    def give_up(self) -> None:
        """Let other servers go on with all jobs, and take no more."""
        self._leaving = True
        for entry in self._entries.values():
            entry.signals.give_up()

    def close(self) -> None:
        """Give all jobs up and wait a little until that is written down."""
        self.give_up()
        until = self._context.clock() + _CLOSING_S
        for entry in list(self._entries.values()):
            if entry.thread is not None:
                entry.thread.join(max(0.0, until - self._context.clock()))

    def _has_room(self, wanted: JobRequest) -> bool:
        """Return whether one more job may wait; another robot's newest may have to come again for it."""
        here = [entry for entry in self._entries.values() if not entry.signals.giving_up]
        if len(here) < self._serving.max_running_jobs + self._serving.max_waiting_jobs:
            return True
        jobs = [((entry.wanted.tenant, entry.wanted.robot), entry.what == WAITS) for entry in here]
        row = who_makes_room(jobs, (wanted.tenant, wanted.robot))
        if row is None:
            return False
        here[row].signals.give_up()
        waiters, here[row].waiters = here[row].waiters, []
        for waiter in waiters:
            self._fail(waiter.job, _too_many())
        return True

    def _wanted(self, job: QueuedCommand) -> JobRequest:
        command = job.command
        key = job_key(command.service, command.payload, self._settings_digest)
        return JobRequest(
            service=command.service,
            payload=command.payload,
            tenant=job.owner.tenant,
            robot=job.robot,
            key=key,
            quota_bytes=quota_bytes(job.owner.claims, self._context.quota_bytes),
        )

    def _begin(self, entry: _Entry) -> None:
        owner = self._new_owner()

        def work() -> None:
            told = self._loop.call_soon_threadsafe

            def tell(share: float, what: str) -> None:
                told(self._told, entry, share, what)

            try:
                outcome = run_job(entry.wanted, self._context, entry.signals, tell, owner)
            except Exception as error:  # noqa: BLE001  a defect of ours must not leave the robot without an answer
                self._log.error("job-defect", service=entry.wanted.service, reason=repr(error))
                outcome = JobOutcome(error=RsePfError("the job failed", hint="the server's log has it"))
            told(self._ended, entry, outcome)
            if not outcome.is_given_up:
                self._sweep.turn()

        entry.thread = threading.Thread(target=work, name=f"job-{entry.wanted.key[:8]}", daemon=True)
        entry.thread.start()

    def _told(self, entry: _Entry, share: float, what: str) -> None:
        entry.share, entry.what = share, what
        self._tell(entry)

    def _tell(self, entry: _Entry) -> None:
        now = self._context.clock()
        for waiter in entry.waiters:
            pause_s = waiter.told_s + _PROGRESS_PAUSE_S - now
            if pause_s <= 0:
                waiter.told_s = now
                progress = Progress(id=waiter.job.command.id, done=entry.share, what=entry.what)
                self._progress(waiter.job.owner, progress)
            elif not waiter.is_told_later:
                waiter.is_told_later = True
                self._loop.call_later(pause_s, functools.partial(self._tell_later, entry, waiter))

    def _tell_later(self, entry: _Entry, waiter: _Waiter) -> None:
        waiter.is_told_later = False
        if waiter in entry.waiters:
            self._tell(entry)

    def _ended(self, entry: _Entry, outcome: JobOutcome) -> None:
        wanted = entry.wanted
        del self._entries[wanted.tenant, wanted.robot, wanted.key]
        waiters, entry.waiters = entry.waiters, []
        entry.signals.close()
        code = "given-up" if outcome.is_given_up else "ok" if outcome.error is None else outcome.error.code
        self._log.info(
            "job", robot=wanted.robot, service=wanted.service, job=wanted.key[:16], code=code,
            object=outcome.object[:16], compute_ms=round(outcome.compute_ms, 3),
        )  # fmt: skip
        reply = None
        if outcome.reply is not None:
            reply = msgspec.msgpack.decode(outcome.reply, ext_hook=extension_hook)
        for waiter in () if outcome.is_given_up else waiters:
            if outcome.error is not None:
                self._fail(waiter.job, outcome.error)
                continue
            result = Result(
                id=waiter.job.command.id, reply=reply, server=self._context.server_id,
                compute_ms=outcome.compute_ms, object=outcome.object,
            )  # fmt: skip
            self._answer(waiter.job, result)
        for job in entry.again:
            self.submit(job)

    def _fail(self, job: QueuedCommand, error: RsePfError) -> None:
        self._answer(job, failure_of(error, job.command, server=self._context.server_id))


def _too_many() -> Busy:
    return Busy("too many jobs wait", hint="try again later", retry_after_ms=_BUSY_RETRY_MS)
