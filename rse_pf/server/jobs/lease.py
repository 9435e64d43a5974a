"""Store the record of a job, and decide by its lease which worker may run the job.

The record is an object in the store that all servers share.  The worker that runs the job holds the lease: it
is named in the field ``owner``, and renews the lease by writing the record (`rse_pf.storage.lease`).  No
server searches for jobs whose worker has failed: such a job starts again when its robot repeats the request.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, Literal

import msgspec

from rse_pf.errors import BadMessage, BadRequest, StoreError
from rse_pf.identity import RobotId
from rse_pf.storage.lease import Lease
from rse_pf.storage.object_store import ObjectStore
from rse_pf.wire.arrays import binary_encode_hook

__all__ = [
    "MAX_TRIES",
    "JobLease",
    "JobRecord",
    "Verdict",
    "decode_record",
    "job_key",
    "record_name",
    "renewal_s",
    "verdict_on",
]  # fmt: skip

_RENEWALS_PER_LEASE = 5  # renewals within ``serving.job_lease_s``, so that a lease outlives failed renewals
_MAX_RENEWAL_S = 1.0  # longest time between renewals in seconds, and so until followers get new progress
MAX_TRIES = 3  # a job is not run again after so many workers failed while they ran it: it may crash them

State = Literal["running", "given-up", "done", "failed", "swept"]
Verdict = Literal["take", "follow", "done", "failed", "poison"]
"""What a worker does about a job: ``take`` runs it, ``follow`` waits for the worker that runs it, ``done``
and ``failed`` return the stored result or error, ``poison`` refuses it after `MAX_TRIES` failed workers."""


class JobRecord(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The record of one job.

    Attributes:
        state: ``running``; ``given-up`` for other servers; ``done`` or ``failed``; ``swept`` just before the
            record is deleted.
        owner: Name of the worker that holds the lease; "" if none does.
        beat: Number of renewals of the lease.
        tries: 1, plus the number of workers that failed one after the other while they ran the job.
        share: Progress of the job, 0..1; ``what`` describes it.
        cancel: Whether a follower asks the holder of the lease to cancel the job.
        reply: sha256 of the reply, which is an object of the robot; ``reply_bytes`` is its length.
        compute_ms: Duration of the computation; ``server`` is the server that ran the job.
        code: Error of a failed job, with ``message`` and ``hint``.
        marked_s: Unix time at which a garbage collection first read the record in its present form; 0 after
            each write by the holder of the lease.
    """

    state: State
    owner: str
    beat: int = 0
    tries: int = 1
    share: float = 0.0
    what: str = ""
    cancel: bool = False
    reply: str = ""
    reply_bytes: int = 0
    compute_ms: float = 0.0
    server: str = ""
    code: str = ""
    message: str = ""
    hint: str = ""
    marked_s: float = 0.0


_decode = msgspec.json.Decoder(JobRecord).decode


def decode_record(name: str, data: bytes) -> JobRecord:
    """Return the record in *data*, the bytes of the object *name*; raises StoreError if there is none."""
    try:
        return _decode(data)
    except msgspec.DecodeError as error:
        raise StoreError(f"the object {name!r} is no record of a job", hint="delete this object") from error


def job_key(service: str, payload: Any, settings: str) -> str:
    """Return the key of a job: the sha256 of the service's name, the payload and the settings.

    Args:
        service: Name of the service.
        payload: The payload of the command, with references to stored objects in place of their bytes.
        settings: Digest of the settings on which the result depends.

    Raises:
        BadRequest: The payload cannot be encoded.
    """
    try:
        plain = msgspec.msgpack.encode(
            [service, settings, payload], enc_hook=binary_encode_hook, order="deterministic"
        )
    except (BadMessage, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise BadRequest("the request cannot be encoded", hint="send numbers, strings and lists") from error
    return hashlib.sha256(plain).hexdigest()


def record_name(robot: RobotId, key: str) -> str:
    """Return the object name of the record of a robot's job: ``jobs/TENANT/ROBOT[=THUMBPRINT]/KEY``."""
    return f"jobs/{robot.folder}/{key}"


def renewal_s(lease_s: float) -> float:
    """Return the seconds between two renewals of a lease that expires *lease_s* after the last one."""
    return min(_MAX_RENEWAL_S, lease_s / _RENEWALS_PER_LEASE)


def verdict_on(
    record: JobRecord | None, *, unchanged_s: float, lease_s: float, is_watched: bool, is_ours: bool = False
) -> Verdict:
    """Return what a worker does about a job that one of its robots requests.

    1. Without a record, or after the job was given up, the worker takes it.  The same holds if the record
       names this worker as running although it does not run the job: it could not write how its last run
       ended.
    2. The result of a job that is done is returned.
    3. A failed job returns its error if this worker has waited for that run; otherwise the job is run again.
    4. While the record changed within *lease_s*, the worker follows the other worker that runs the job.
    5. After that, the worker takes the job, unless `MAX_TRIES` workers failed while they ran it: poison.

    Args:
        record: The record in the store; None if there is none.
        unchanged_s: Seconds for which this process has seen the record unchanged.
        lease_s: Seconds without a renewal after which the holder of the lease counts as failed.
        is_watched: Whether this process has seen the job of this record running, and waits for it.
        is_ours: Whether this process is the owner in the record; it does not run the job now.
    """
    if record is None or record.state == "given-up" or (record.state == "running" and is_ours):
        return "take"
    if record.state == "done":
        return "done"
    if record.state == "failed":
        return "failed" if is_watched else "take"
    if unchanged_s < lease_s:
        return "follow"  # another worker renews the lease, or a garbage collection deletes the record soon
    if record.state == "swept":
        return "take"
    return "take" if record.tries < MAX_TRIES else "poison"


class JobLease:
    """Reads and writes the record of one job for one worker, which may hold its lease.

    ``is_watched`` is whether this worker has seen the job running.
    """

    def __init__(self, store: ObjectStore, name: str, owner: str, clock: Callable[[], float]) -> None:
        """Read nothing yet.

        Args:
            store: The object store, shared by all servers.
            name: Object name of the record, see `record_name`.
            owner: Name of this worker, unique among the workers of all servers.
            clock: Returns monotonic seconds.
        """
        self.is_watched = False
        self._owner = owner
        self._lease = Lease(store, name, decode_record, clock)

    @property
    def record(self) -> JobRecord | None:
        """The record as it was read or written last; None if there was none."""
        return self._lease.record

    @property
    def unchanged_s(self) -> float:
        """Seconds since this worker last noticed a change of the record."""
        return self._lease.unchanged_s

    @property
    def is_ours(self) -> bool:
        """Whether this worker was the owner when it last read or wrote the record."""
        return self.record is not None and self.record.owner == self._owner

    def read(self) -> JobRecord | None:
        """Read the record; raises StoreError."""
        return self._watch(self._lease.read())

    def take(self) -> bool:
        """Claim the lease and return True; return False if another worker wrote the record first.

        ``tries`` is increased if the record is one of another worker that stopped renewing its lease.  It
        begins with 1 after a run that was given up or that failed.
        """
        before, tries = self.record, 1
        if before is not None and before.state == "running":
            tries = before.tries + (not self.is_ours)
        return self._write(JobRecord(state="running", owner=self._owner, tries=tries))

    def renew(self, share: float, what: str) -> bool:
        """Renew the lease and write the progress: the *share* (0..1) that is done, and *what* is being done.

        Return False if another worker has the lease or changed the record, or asks to cancel the job.
        """
        if self.record is None or not self.is_ours:
            return False
        beat = msgspec.structs.replace(
            self.record, beat=self.record.beat + 1, share=share, what=what, marked_s=0.0
        )
        return self._write(beat) and not beat.cancel

    def end(self, record: JobRecord) -> bool:
        """Replace the record by *record*, the outcome of the job; False if another worker has the lease."""
        while self.is_ours:
            if self._write(msgspec.structs.replace(record, owner=self._owner)):
                return True
        return False

    def ask_to_cancel(self) -> None:
        """Ask the worker that runs the job, by its record, to cancel it; do nothing if it does not run."""
        while self.record is not None and self.record.state == "running" and not self.record.cancel:
            if self._write(msgspec.structs.replace(self.record, cancel=True)):
                return

    def _write(self, record: JobRecord) -> bool:
        """Write *record* and return True; return False, and know the stored record, if it has changed."""
        is_written = self._lease.write(record)
        if not is_written:
            self._watch(self.record)
        return is_written

    def _watch(self, record: JobRecord | None) -> JobRecord | None:
        """Note whether the job of *record* runs, and return *record*."""
        if record is not None and record.state == "running":
            self.is_watched = True
        return record
