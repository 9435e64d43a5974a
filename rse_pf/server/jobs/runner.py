"""Run one job, or follow its run by another worker, in a thread of this worker; return its outcome.

1. Read the record of the job.  If the job is done, return its stored result.
2. If another worker runs the job, report its progress until the job has ended or its lease has expired, and
   continue with step 1.
3. Otherwise wait for a slot of this server, claim the lease, run the job in a process, and renew the lease
   meanwhile.

The thread only waits: for the store, for a slot, or for the process.  The process has exited when `run_job`
returns.
"""

from __future__ import annotations

import os
import select
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

from rse_pf.config import PlatformSettings
from rse_pf.errors import (
    Cancelled,
    Crashed,
    Expired,
    LimitExceeded,
    NotFound,
    Poison,
    QuotaExceeded,
    RsePfError,
    StoreError,
    error_from_code,
)
from rse_pf.identity import object_name
from rse_pf.processes.ipc import FrameReader
from rse_pf.processes.linux import cpu_seconds
from rse_pf.processes.start import Child, how_ended
from rse_pf.server.jobs.lease import MAX_TRIES, JobLease, JobRecord, record_name, renewal_s, verdict_on
from rse_pf.server.jobs.process import JobRequest, inline_bytes, retry_store
from rse_pf.server.jobs.slots import JobSlots
from rse_pf.server.robot_store import store_within_quota
from rse_pf.service import Report
from rse_pf.storage.object_store import ObjectStore, digest_of
from rse_pf.storage.quotas import Accounts

__all__ = ["JobContext", "JobOutcome", "JobSignals", "run_job"]

MAX_JOB_S = 3600.0  # seconds after which a running job is killed: the largest accepted merge takes an hour
_POLL_SHARE = 0.5  # a follower reads the record after this share of the time between two renewals
_KILL_AFTER_S = 0.6  # seconds in which the process of a cancelled job can exit before it is killed
_READ_BYTES = 1 << 18  # bytes read from the process at a time
# The text ``what`` of the progress of a job that waits for a slot, and of one whose process starts.
WAITING = "waits for its turn"
STARTING = "starts"


@dataclass(frozen=True, slots=True, kw_only=True)
class JobContext:
    """The values that all jobs of one worker share.

    ``start`` starts the process of a job, ``clock`` returns monotonic seconds.
    """

    store: ObjectStore
    slots: JobSlots
    settings: PlatformSettings
    server_id: str
    start: Callable[[JobRequest], Child]
    clock: Callable[[], float]
    services: frozenset[str] = frozenset()
    """Names of the long services, whose commands run as jobs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOutcome:
    """How a job ended: with a stored reply, with an error, or with neither if it was given up."""

    object: str = ""
    """Digest of the stored reply, an object of the robot."""
    reply: bytes | None = None
    """The reply as MessagePack; None if it is larger than `inline_bytes`: the robot gets the digest only."""
    compute_ms: float = 0.0
    error: RsePfError | None = None
    cpu_s: float = 0.0
    """CPU seconds of the job's process; 0 if another worker ran the job."""

    @property
    def is_given_up(self) -> bool:
        """Whether the job was stopped before its end, so that another server should run it."""
        return not self.object and self.error is None


class JobSignals:
    """The signals ``cancelled`` and ``giving_up`` of the event loop to the thread of a job; never cleared."""

    def __init__(self) -> None:
        self.cancelled = False
        self.giving_up = False
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._lock = threading.Lock()

    def cancel(self) -> None:
        """Signal that the robot cancelled the job, and wake the thread."""
        self.cancelled = True
        self._wake()

    def give_up(self) -> None:
        """Signal that another server should run the job, and wake the thread."""
        self.giving_up = True
        self._wake()

    def wait(self, seconds: float, *others: socket.socket) -> bool:
        """Wait at most *seconds* for a signal or for bytes on *others*; return False if a signal was set."""
        poller = select.poll()  # select() accepts no descriptor above 1,023, and a worker has thousands
        poller.register(self._fd, select.POLLIN)
        for other in others:
            poller.register(other, select.POLLIN)
        if any(fd == self._fd for fd, _ in poller.poll(max(0.0, 1e3 * seconds))):
            os.eventfd_read(self._fd)
        return not (self.cancelled or self.giving_up)

    def close(self) -> None:
        """Close the descriptor of this object; later signals wake nothing."""
        with self._lock:
            os.close(self._fd)
            self._fd = -1

    def _wake(self) -> None:
        with self._lock:
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)


def run_job(
    request: JobRequest, context: JobContext, signals: JobSignals, report: Report, owner: str
) -> JobOutcome:
    """Run the job, or follow its run by another worker, until it has ended; return the outcome.

    Args:
        request: The request of the job.
        context: The values that all jobs of the worker share.
        signals: Signals of the worker's event loop.
        report: Called in this thread with the share of the job that is done (0..1), and what is being done.
        owner: Name of this worker, unique among the workers of all servers; it runs each job at most once at
            a time.
    """
    name = record_name(request.robot, request.key)
    lease = JobLease(context.store, name, owner, context.clock)
    try:
        return _follow_or_run(request, context, signals, report, lease)
    except RsePfError as error:
        return JobOutcome(error=error)


def _follow_or_run(
    request: JobRequest, context: JobContext, signals: JobSignals, report: Report, lease: JobLease
) -> JobOutcome:
    """Repeat the steps of this module until the job has an outcome, and return it."""
    serving = context.settings.serving
    while True:
        if signals.giving_up:
            return JobOutcome()
        record = lease.read()
        if signals.cancelled:
            lease.ask_to_cancel()
            return JobOutcome(error=_cancelled_error())
        verdict = verdict_on(
            record, unchanged_s=lease.unchanged_s, lease_s=serving.job_lease_s,
            is_watched=lease.is_watched, is_ours=lease.is_ours,
        )  # fmt: skip
        if verdict == "follow" and record is not None:
            report(record.share, record.what)
            signals.wait(renewal_s(serving.job_lease_s) * _POLL_SHARE)
            continue
        if verdict == "failed" and record is not None:
            return JobOutcome(error=error_from_code(record.code, record.message, hint=record.hint))
        if verdict == "poison":
            reason = f"{MAX_TRIES} workers exited, or did not reach the store, while they ran this job"
            name = record_name(request.robot, request.key)
            hint = f"send less at once; the operator can allow it again by deleting the object {name}"
            return JobOutcome(error=Poison(reason, hint=hint))
        if verdict == "done" and record is not None:
            stored = _stored_outcome(request, context, record)
            if stored is not None:
                return stored
        report(0.0, WAITING)
        if not context.slots.acquire(request.robot, signals.wait):
            continue
        try:
            if lease.take():
                outcome = _JobRun(request, context, signals, report, lease).work()
                if outcome is not None:
                    return outcome
        finally:
            context.slots.release()


def _stored_outcome(request: JobRequest, context: JobContext, record: JobRecord) -> JobOutcome | None:
    """Return the stored result of a job that is done; None if the robot has deleted its object meanwhile."""
    name = object_name(request.robot, record.reply)
    try:
        reply = None
        if record.reply_bytes > inline_bytes(context.settings):
            context.store.head(name)
        else:
            reply = context.store.get(name)
    except NotFound:
        return None
    return JobOutcome(object=record.reply, reply=reply, compute_ms=record.compute_ms)


class _JobRun:
    """Runs a job, whose lease this worker holds, in a process, and writes the outcome to its record."""

    def __init__(
        self, request: JobRequest, context: JobContext, signals: JobSignals, report: Report, lease: JobLease
    ) -> None:
        self._request = request
        self._context = context
        self._signals = signals
        self._report = report
        self._lease = lease
        self._done, self._what = 0.0, STARTING
        self._frames = FrameReader(context.settings.data.max_object_bytes)
        self._end: list[Any] | None = None
        self._is_over = False

    def work(self) -> JobOutcome | None:
        """Run the job and return its outcome; None if another worker took the lease meanwhile."""
        self._report(0.0, STARTING)
        process = self._context.start(self._request)
        try:
            why = self._supervise(process)
        finally:
            cpu_s = cpu_seconds(process.pid)
            exit_code = process.kill()  # all messages of the process have been read
        outcome = self._outcome_of(why, exit_code)
        return None if outcome is None else replace(outcome, cpu_s=cpu_s)

    def _outcome_of(self, why: str, exit_code: int) -> JobOutcome | None:
        """Write the outcome to the record and return it; *why* is the result of `_supervise`."""
        if why == "lost":
            return None
        if why == "given-up":
            self._end_lease(JobRecord(state="given-up", owner=""))
            return JobOutcome()
        if why == "cancelled":
            return self._store_failure(_cancelled_error())
        if why == "late":
            return self._store_failure(
                Expired(f"the job took longer than {MAX_JOB_S:g} s", hint="send less at once")
            )
        if self._end is None:
            return self._store_failure(_crash_error(exit_code))
        if self._end[0] == "stored":
            return self._report_stored(*self._end[1:])
        if self._end[0] == "done":
            return self._store_reply(*self._end[1:])
        return self._store_failure(
            error_from_code(str(self._end[1]), str(self._end[2]), hint=str(self._end[3]))
        )

    def _supervise(self, process: Child) -> Literal["over", "lost", "given-up", "cancelled", "late"]:
        """Read from the process and renew the lease until the run ends; return why it ended.

        The process may still run; the caller kills it.  The result is one of:

        - over: the process has sent its final message, or has exited.
        - lost: another worker has the lease.
        - given-up: this worker gives the job up (`JobSignals.give_up`), so that another server can run it.
        - cancelled: the robot cancelled the job, and the process exited without a final message, or did not
          exit within `_KILL_AFTER_S`.
        - late: `MAX_JOB_S` have passed.
        """
        serving, clock, signals = self._context.settings.serving, self._context.clock, self._signals
        began = clock()
        next_heartbeat, killed_s = began + renewal_s(serving.job_lease_s), float("inf")
        while not self._is_over:
            now = clock()
            if signals.giving_up:
                return "given-up"
            if self._is_cancelled and killed_s == float("inf"):
                process.say(["cancel"])
                killed_s = now + _KILL_AFTER_S
            if now >= killed_s:
                return "cancelled"
            if now - began >= MAX_JOB_S:
                return "late"
            if now >= next_heartbeat:
                next_heartbeat = now + renewal_s(serving.job_lease_s)
                self._renew()
                if not self._lease.is_ours:
                    return "lost"
            signals.wait(min(next_heartbeat, killed_s) - clock(), process.connection)
            self._read(process)
        return "cancelled" if self._is_cancelled and self._end is None else "over"

    @property
    def _is_cancelled(self) -> bool:
        """Whether the robot cancelled the job here, or by another worker that wrote this to the record."""
        record = self._lease.record
        return self._signals.cancelled or (record is not None and self._lease.is_ours and record.cancel)

    def _renew(self) -> None:
        """Renew the lease; a failure of the store is ignored, so that the job continues meanwhile."""
        with suppress(StoreError):
            self._lease.renew(self._done, self._what)

    def _read(self, process: Child) -> None:
        """Read what has arrived from the process: report progress, store the final message in ``_end``."""
        try:
            data = process.connection.recv(_READ_BYTES, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        self._is_over = not data
        try:
            for message in self._frames.feed(data):
                if message[0] == "progress":
                    self._done, self._what = float(message[1]), str(message[2])
                    self._report(self._done, self._what)
                else:
                    self._end, self._is_over = message, True
        except LimitExceeded as error:
            self._end, self._is_over = ["failed", error.code, error.message, "ask for less"], True

    def _store_reply(self, compute_ms: float, reply: bytes) -> JobOutcome:
        """Store the reply in this worker, for a process without access to the store; return the outcome."""
        context, request, digest = self._context, self._request, digest_of(reply)
        try:
            accounts = Accounts(context.store, context.settings.data)
            retry_store(
                lambda: store_within_quota(context.store, accounts, request.robot, reply, request.quota_bytes)
            )
        except QuotaExceeded as error:
            return self._store_failure(error)
        inline = reply if len(reply) <= inline_bytes(context.settings) else None
        return self._report_stored(compute_ms, digest, len(reply), inline)

    def _report_stored(self, compute_ms: float, digest: str, size: int, reply: bytes | None) -> JobOutcome:
        """Write to the record that the reply is stored as object *digest*, and return the outcome.

        *size* is the length of the stored reply; *reply* is the reply itself, None if it is large.
        """
        self._end_lease(
            JobRecord(
                state="done", owner="", reply=digest, reply_bytes=size, compute_ms=compute_ms,
                server=self._context.server_id,
            )
        )  # fmt: skip
        return JobOutcome(object=digest, reply=reply, compute_ms=compute_ms)

    def _store_failure(self, error: RsePfError) -> JobOutcome:
        """Write *error* to the record as the outcome of the job, and return it."""
        self._end_lease(
            JobRecord(state="failed", owner="", code=error.code, message=error.message, hint=error.hint)
        )
        return JobOutcome(error=error)

    def _end_lease(self, record: JobRecord) -> None:
        """Write *record*, the outcome, in place of the lease; repeat this after failures of the store."""
        retry_store(lambda: self._lease.end(record))


def _cancelled_error() -> RsePfError:
    return Cancelled("the robot cancelled the command")


def _crash_error(code: int) -> RsePfError:
    return Crashed(
        f"the job's process ended: {how_ended(code)}",
        hint="the server's log has the last output of the process",
    )
