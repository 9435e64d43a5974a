"""A job server: it takes jobs that wait in the store, runs them, and serves no robots.

It keeps no state of its own: a job whose job server dies is taken by another after its lease has expired.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from rse_pf.backend.jobs.lease import JobLease, record_name, verdict_on
from rse_pf.backend.jobs.queue import JobOffer, JobQueue
from rse_pf.backend.jobs.runner import WAITING, JobContext, JobOutcome, JobSignals, run_job
from rse_pf.backend.ports import Log
from rse_pf.errors import StoreError
from rse_pf.identity import RobotId
from rse_pf.lease import ObjectRecords

__all__ = ["JobServer"]

_CLOSE_TIMEOUT_S = 5.0
_DECIDE_TIMEOUT_S = 5.0
"""For this long a look waits until it is known whether a job runs here; it takes a few requests."""
_MAX_SERVED = 1000
"""Robots whose turn is remembered."""


@dataclass(eq=False, slots=True)
class _Running:
    signals: JobSignals = field(default_factory=JobSignals)
    is_decided: threading.Event = field(default_factory=threading.Event)
    """Set when the job runs here, or will not."""
    thread: threading.Thread | None = None


class JobServer:
    """Takes jobs of a queue as long as slots are free; `step` is called repeatedly."""

    def __init__(
        self, context: JobContext, queue: JobQueue, log: Log, new_owner: Callable[[], str], slots: int
    ) -> None:
        """Run nothing yet.

        Args:
            context: Store, slots, processes and settings; it does not follow.
            queue: Where jobs wait.
            log: Of this server.
            new_owner: Returns a name that is unique among all servers.
            slots: How many jobs run here at the same time.
        """
        self._context = context
        self._queue = queue
        self._log = log
        self._new_owner = new_owner
        self._slots = slots
        self._served: dict[str, int] = {}
        self._jobs: dict[tuple[RobotId, str], _Running] = {}
        self._watched: dict[str, tuple[JobLease, str]] = {}
        self._lock = threading.Lock()
        self._is_leaving = False

    @property
    def running(self) -> int:
        """Jobs that run here."""
        with self._lock:
            return len(self._jobs)

    def step(self) -> None:
        """Begin with jobs that wait; raises StoreError."""
        if self._is_leaving or self.running >= self._slots:
            return
        offered: set[str] = set()
        for offer in self._queue.offers(self._served):
            if self.running >= self._slots:
                return
            name = record_name(offer.request.robot, offer.request.key)
            offered.add(name)
            if (offer.request.robot, offer.request.key) in self._jobs or not self._may_begin(name):
                continue
            self._begin(offer, *self._watched.pop(name)).is_decided.wait(_DECIDE_TIMEOUT_S)
        for name in self._watched.keys() - offered:
            del self._watched[name]

    def leave(self) -> None:
        """Take no more jobs, and leave those that run to other servers."""
        self._is_leaving = True
        with self._lock:
            jobs = list(self._jobs.values())
        for job in jobs:
            job.signals.give_up()
        until = self._context.clock() + _CLOSE_TIMEOUT_S
        for job in jobs:
            if job.thread is not None:
                job.thread.join(max(0.0, until - self._context.clock()))

    def _may_begin(self, name: str) -> bool:
        """Return whether no other server has the lease of the job with the record *name*, or renews it."""
        context = self._context
        if name not in self._watched:
            owner = self._new_owner()
            self._watched[name] = (JobLease(ObjectRecords(context.store), name, owner, context.clock), owner)
        lease, _ = self._watched[name]
        try:
            record = lease.read()
        except StoreError as error:
            self._log.warning("job-record", record=name, reason=error.message)
            return False
        verdict = verdict_on(
            record,
            unchanged_s=lease.unchanged_s,
            lease_s=context.settings.serving.job_lease_s,
            is_watched=lease.is_watched,
        )
        if verdict == "failed":  # the server that ran it withdraws the offer; a later one is a new job
            del self._watched[name]
        return verdict not in ("follow", "failed")

    def _begin(self, offer: JobOffer, lease: JobLease, owner: str) -> _Running:
        job, request = _Running(), offer.request
        latest = max(self._served.values(), default=0)
        if len(self._served) >= _MAX_SERVED:
            self._served.clear()
        self._served[request.robot.folder] = latest + 1
        with self._lock:
            self._jobs[request.robot, request.key] = job

        def tell(done: float, what: str) -> None:
            if what != WAITING:
                job.is_decided.set()

        def work() -> None:
            outcome = JobOutcome()
            try:
                outcome = run_job(request, self._context, job.signals, tell, owner, lease)
            except Exception as error:  # noqa: BLE001  a defect must not end the other jobs
                self._log.error("job-defect", service=request.service, reason=repr(error))
            finally:
                with self._lock:
                    del self._jobs[request.robot, request.key]
                job.is_decided.set()
                job.signals.close()
            code = (
                "given-up" if outcome.is_given_up else "ok" if outcome.error is None else outcome.error.code
            )
            self._log.info(
                "job", robot=request.robot, service=request.service, job=request.key[:16], code=code,
                object=outcome.object[:16], compute_ms=round(outcome.compute_ms, 3), trace=request.trace,
                cpu_s=round(outcome.cpu_s, 3),
            )  # fmt: skip

        job.thread = threading.Thread(target=work, name=f"job-{request.key[:8]}", daemon=True)
        job.thread.start()
        return job
