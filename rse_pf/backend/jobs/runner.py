"""One wanted job, from the first look at its record to its outcome: follow it, do it, or return its result.

Runs in a thread of the worker, because all it does is wait: for the store, for a turn, for the job's process.
Promises that a process which it started is gone when it returns, and that a job ends the same way whoever
works on it.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

from rse_pf.backend.jobs.lease import MAX_TRIES, JobLease, JobRecord, record_name, verdict_on
from rse_pf.backend.jobs.slots import JobSlots
from rse_pf.backend.quota import store_within
from rse_pf.backend.sandbox.ipc import FrameReader, encode_message
from rse_pf.config import ServingSettings
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
from rse_pf.object_store import ObjectStore, digest_of, object_name

__all__ = ["JobContext", "JobOutcome", "JobRequest", "JobSignals", "Process", "run_job"]

_POLL_SHARE = 0.5
"""Of the time between two renewals: how often one who follows looks."""
_PATIENCE_S = 0.6
"""A job that is told to end and does not is killed after this."""
_READ_BYTES = 1 << 18
_STORE_TRIES = 3
WAITS, STARTS = "waits for its turn", "starts"


class Process(Protocol):
    """A started job process."""

    connection: socket.socket

    def kill(self) -> None:
        """End it, whatever it does, and reap it."""

    def wait(self) -> int:
        """Return how it ended, once it did; negative for a signal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRequest:
    """A job that a robot asked for."""

    service: str
    payload: Any
    tenant: str
    robot: str
    key: str
    quota_bytes: float
    """Of all that the robot stores, its results among it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobContext:
    """What all jobs of one worker share."""

    store: ObjectStore
    slots: JobSlots
    settings: ServingSettings
    quota_bytes: float
    """Of a robot whose token says nothing of it."""
    max_bytes: int
    """Of a reply."""
    inline_bytes: int
    """Larger replies are named only."""
    server_id: str
    start: Callable[[JobRequest], Process]
    clock: Callable[[], float]


@dataclass(frozen=True, slots=True, kw_only=True)
class JobOutcome:
    """What became of a job: a reply under its digest, an error, or neither: it was given up."""

    object: str = ""
    reply: bytes | None = None
    """MessagePack; None if it is too large for a message."""
    compute_ms: float = 0.0
    error: RsePfError | None = None

    @property
    def is_given_up(self) -> bool:
        """Whether another server should go on."""
        return not self.object and self.error is None


class JobSignals:
    """What the worker tells the thread of a job; each can only be set."""

    def __init__(self) -> None:
        self.cancelled = False
        self.giving_up = False
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._lock = threading.Lock()

    def cancel(self) -> None:
        """The robot takes the job back."""
        self.cancelled = True
        self._wake()

    def give_up(self) -> None:
        """The server leaves."""
        self.giving_up = True
        self._wake()

    def rest(self, seconds: float, *others: socket.socket) -> bool:
        """Wait until something happens, at most so long; return whether the job is still wanted here."""
        watched: list[Any] = [self._fd, *others]
        ready, _, _ = select.select(watched, [], [], max(0.0, seconds))
        if self._fd in ready:
            os.eventfd_read(self._fd)
        return not (self.cancelled or self.giving_up)

    def close(self) -> None:
        """Forget it; later signals are lost."""
        with self._lock:
            os.close(self._fd)
            self._fd = -1

    def _wake(self) -> None:
        with self._lock:
            if self._fd >= 0:
                os.eventfd_write(self._fd, 1)


Tell = Callable[[float, str], None]


def run_job(
    wanted: JobRequest, context: JobContext, signals: JobSignals, tell: Tell, owner: str
) -> JobOutcome:
    """Return what became of the job; blocks until then.

    Args:
        wanted: The job.
        context: Of the worker.
        signals: Set by the worker's loop.
        tell: Told the share that is done, and what; called in this thread.
        owner: Unique to this process and this call.
    """
    name = record_name(wanted.tenant, wanted.robot, wanted.key)
    lease = JobLease(context.store, name, owner, context.clock)
    try:
        return _pursue(wanted, context, signals, tell, lease)
    except RsePfError as error:
        return JobOutcome(error=error)


def _pursue(
    wanted: JobRequest, context: JobContext, signals: JobSignals, tell: Tell, lease: JobLease
) -> JobOutcome:
    serving = context.settings
    while True:
        if signals.giving_up:
            return JobOutcome()
        record = lease.look()
        if signals.cancelled:
            lease.ask_to_cancel()
            return JobOutcome(error=_cancelled())
        verdict = verdict_on(
            record, unchanged_s=lease.unchanged_s, lease_s=serving.job_lease_s, is_watched=lease.is_watched
        )
        if verdict == "follow" and record is not None:
            tell(record.share, record.what)
            signals.rest(serving.job_heartbeat_s * _POLL_SHARE)
            continue
        if verdict == "failed" and record is not None:
            return JobOutcome(error=error_from_code(record.code, record.message, hint=record.hint))
        if verdict == "poison":
            return JobOutcome(error=_poison())
        if verdict == "done" and record is not None:
            stored = _stored(wanted, context, record)
            if stored is not None:
                return stored
        tell(0.0, WAITS)
        if not context.slots.acquire((wanted.tenant, wanted.robot), signals.rest):
            continue
        try:
            if lease.take():
                outcome = _Run(wanted, context, signals, tell, lease).work()
                if outcome is not None:
                    return outcome
        finally:
            context.slots.release()


def _stored(wanted: JobRequest, context: JobContext, record: JobRecord) -> JobOutcome | None:
    """Return the result that *record* names; None if it is gone and has to be made again."""
    name = object_name(wanted.tenant, wanted.robot, record.reply)
    try:
        if record.reply_bytes > context.inline_bytes:
            context.store.head(name)
            reply = None
        else:
            reply = context.store.get(name)
    except NotFound:
        return None
    return JobOutcome(object=record.reply, reply=reply, compute_ms=record.compute_ms)


class _Run:
    """The work on a job that is ours."""

    def __init__(
        self, wanted: JobRequest, context: JobContext, signals: JobSignals, tell: Tell, lease: JobLease
    ) -> None:
        self._wanted = wanted
        self._context = context
        self._signals = signals
        self._tell = tell
        self._lease = lease
        self._share, self._what = 0.0, STARTS
        self._frames = FrameReader(context.max_bytes)
        self._end: list[Any] | None = None
        self._is_over = False

    def work(self) -> JobOutcome | None:
        """Return the outcome; None if another server took the job from us."""
        self._tell(0.0, STARTS)
        process = self._context.start(self._wanted)
        try:
            why = self._attend(process)
        finally:
            process.kill()  # what it had to say it has said
        if why == "lost":
            return None
        if why == "given-up":
            self._leave(JobRecord(state="given-up", owner=""))
            return JobOutcome()
        if why == "cancelled":
            return self._failed(_cancelled())
        if why == "late":
            longest_s = self._context.settings.max_job_s
            return self._failed(
                Expired(f"the job took longer than {longest_s:g} s", hint="send less at once")
            )
        code = process.wait()
        if self._end is None:
            return self._failed(_crashed(code))
        if self._end[0] == "stored":
            return self._stored(*self._end[1:])
        if self._end[0] == "done":
            return self._done(*self._end[1:])
        return self._failed(error_from_code(str(self._end[1]), str(self._end[2]), hint=str(self._end[3])))

    def _attend(self, process: Process) -> Literal["over", "lost", "given-up", "cancelled", "late"]:
        """Listen to the process and renew the lease until one of them ends it."""
        serving, clock, signals = self._context.settings, self._context.clock, self._signals
        began = renewed = clock()
        next_beat, killed_s = began + serving.job_heartbeat_s, float("inf")
        while not self._is_over:
            now = clock()
            if signals.giving_up:
                return "given-up"
            if self._is_cancelled and killed_s == float("inf"):
                _order_to_end(process)
                killed_s = now + _PATIENCE_S
            if now >= killed_s:
                return "cancelled"
            if now - began >= serving.max_job_s:
                return "late"
            if now >= next_beat:
                next_beat = now + serving.job_heartbeat_s
                if self._renew():
                    renewed = clock()
                elif not self._lease.is_ours or clock() - renewed >= serving.job_lease_s:
                    return "lost"
            signals.rest(min(next_beat, killed_s) - clock(), process.connection)
            self._read(process)
        return "cancelled" if self._is_cancelled and self._end is None else "over"

    @property
    def _is_cancelled(self) -> bool:
        record = self._lease.record
        return self._signals.cancelled or (record is not None and self._lease.is_ours and record.cancel)

    def _renew(self) -> bool:
        """A store that fails for a while costs us nothing; one that fails for a whole lease, the job."""
        try:
            return self._lease.renew(self._share, self._what)
        except StoreError:
            return False

    def _read(self, process: Process) -> None:
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
                    self._share, self._what = float(message[1]), str(message[2])
                    self._tell(self._share, self._what)
                else:
                    self._end, self._is_over = message, True
        except LimitExceeded as error:
            self._end, self._is_over = ["failed", error.code, error.message, "ask for less"], True

    def _done(self, compute_ms: float, reply: bytes) -> JobOutcome:
        """Make the reply durable before anybody hears of it, as the process could not."""
        context, wanted, digest = self._context, self._wanted, digest_of(reply)
        try:
            self._patiently(
                lambda: store_within(context.store, wanted.tenant, wanted.robot, reply, wanted.quota_bytes)
            )
        except QuotaExceeded as error:
            return self._failed(error)
        inline = reply if len(reply) <= context.inline_bytes else None
        return self._stored(compute_ms, digest, len(reply), inline)

    def _stored(self, compute_ms: float, digest: str, size: int, reply: bytes | None) -> JobOutcome:
        """Tell everybody where the durable reply is; *reply* itself if it is small."""
        self._leave(
            JobRecord(
                state="done", owner="", reply=digest, reply_bytes=size, compute_ms=compute_ms,
                server=self._context.server_id,
            )
        )  # fmt: skip
        return JobOutcome(object=digest, reply=reply, compute_ms=compute_ms)

    def _failed(self, error: RsePfError) -> JobOutcome:
        self._leave(
            JobRecord(state="failed", owner="", code=error.code, message=error.message, hint=error.hint)
        )
        return JobOutcome(error=error)

    def _leave(self, record: JobRecord) -> None:
        self._patiently(lambda: self._lease.end(record))

    @staticmethod
    def _patiently(act: Callable[[], object]) -> None:
        for _ in range(_STORE_TRIES - 1):
            try:
                act()
                return
            except StoreError:
                continue
        act()


def _order_to_end(process: Process) -> None:
    try:
        process.connection.sendall(encode_message(["cancel"]))
    except OSError:
        return  # it is gone, and reading says so


def _cancelled() -> RsePfError:
    return Cancelled("the robot took the command back")


def _crashed(code: int) -> RsePfError:
    how = f"exit code {code}"
    if code < 0:
        how = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return Crashed(f"the job's process ended: {how}", hint="the server's log has what it said last")


def _poison() -> RsePfError:
    return Poison(
        f"{MAX_TRIES} servers died while they worked on this job",
        hint="send less at once; tell the operator",
    )
