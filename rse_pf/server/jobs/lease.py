"""Store the record of a job, and decide by its lease (`rse_pf.storage.lease`) which worker may run it.

No server looks for jobs without an owner.  A job whose owner has failed starts again when its robot sends the
same request again.
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

_RENEWALS_PER_LEASE = 5  # a lease outlives several failed renewals
_MAX_RENEWAL_S = 1.0  # longest time between renewals, and so until another server shows new progress
MAX_TRIES = 3  # a job whose owners failed this often is not run again: it may have crashed them

State = Literal["running", "given-up", "done", "failed", "swept"]
Verdict = Literal["take", "follow", "done", "failed", "poison"]


class JobRecord(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One job.  ``beat`` counts renewals; ``reply`` is the sha256 of its result."""

    state: State
    owner: str
    beat: int = 0
    tries: int = 1
    share: float = 0.0
    what: str = ""
    cancel: bool = False
    """Set by a follower to request that the owner cancels the job."""
    reply: str = ""
    reply_bytes: int = 0
    compute_ms: float = 0.0
    server: str = ""
    code: str = ""
    message: str = ""
    hint: str = ""
    marked_s: float = 0.0
    """Unix time when a garbage collection first saw the record as it is; 0 after each write of its owner."""


_decode = msgspec.json.Decoder(JobRecord).decode


def decode_record(name: str, data: bytes) -> JobRecord:
    """Return the record in *data*, the object *name*; raises StoreError."""
    try:
        return _decode(data)
    except msgspec.DecodeError as error:
        raise StoreError(f"{name!r} is no record of a job", hint="delete it") from error


def job_key(service: str, payload: Any, settings: str) -> str:
    """Return the digest of a service's name, its inputs (large ones by digest) and the server's settings.

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
    """Return the time between two renewals of a lease that ends after *lease_s* without one, in seconds."""
    return min(_MAX_RENEWAL_S, lease_s / _RENEWALS_PER_LEASE)


def verdict_on(
    record: JobRecord | None, *, unchanged_s: float, lease_s: float, is_watched: bool, is_ours: bool = False
) -> Verdict:
    """Return the action that follows from the record of a job that a robot asked for.

    Args:
        record: As it stands in the store; None if there is none.
        unchanged_s: For how long this process has seen it unchanged.
        lease_s: After this time without a renewal the owner is considered dead.
        is_watched: Whether this process waits for the run that the record describes; the failure of an
            earlier run is tried again.
        is_ours: Whether this process, which does not run the job now, is its owner: its run failed before
            it could write how it ended.
    """
    if record is None or record.state == "given-up" or (record.state == "running" and is_ours):
        return "take"
    if record.state == "done":
        return "done"
    if record.state == "failed":
        return "failed" if is_watched else "take"
    if unchanged_s < lease_s:
        return "follow"  # the owner renews the record, or a collector is about to delete it
    if record.state == "swept":
        return "take"
    return "take" if record.tries < MAX_TRIES else "poison"


class JobLease:
    """One process's view of the record of one job, and its lease on it."""

    def __init__(self, store: ObjectStore, name: str, owner: str, clock: Callable[[], float]) -> None:
        """Read nothing yet.

        Args:
            store: Shared by all servers.
            name: Name of the record.
            owner: Name that is unique to this process.
            clock: Seconds, monotonic.
        """
        self.is_watched = False
        self._owner = owner
        self._lease = Lease(store, name, decode_record, clock)

    @property
    def record(self) -> JobRecord | None:
        """The record as it was read or written last."""
        return self._lease.record

    @property
    def unchanged_s(self) -> float:
        """The time since the record changed last, in seconds."""
        return self._lease.unchanged_s

    @property
    def is_ours(self) -> bool:
        """Whether this process held the lease when it last read the record."""
        return self.record is not None and self.record.owner == self._owner

    def read(self) -> JobRecord | None:
        """Read the record; raises StoreError."""
        return self._watch(self._lease.read())

    def take(self) -> bool:
        """Become the owner; False if another process did first.

        A run whose owner stopped renewing the lease counts as a try; one that was given up or that failed, or
        that of an owner that lives, does not.
        """
        before, tries = self.record, 1
        if before is not None and before.state == "running":
            tries = before.tries + (not self.is_ours)
        return self._write(JobRecord(state="running", owner=self._owner, tries=tries))

    def renew(self, share: float, what: str) -> bool:
        """Renew the lease with the progress; False if the job was taken or cancelled meanwhile."""
        if self.record is None or not self.is_ours:
            return False
        beat = msgspec.structs.replace(
            self.record, beat=self.record.beat + 1, share=share, what=what, marked_s=0.0
        )
        return self._write(beat) and not beat.cancel

    def end(self, record: JobRecord) -> bool:
        """Replace the lease by the outcome of the job; False if it is no longer ours."""
        while self.is_ours:
            if self._write(msgspec.structs.replace(record, owner=self._owner)):
                return True
        return False

    def ask_to_cancel(self) -> None:
        """Ask the owner of the lease to cancel the job, because the robot cancelled it."""
        while self.record is not None and self.record.state == "running" and not self.record.cancel:
            if self._write(msgspec.structs.replace(self.record, cancel=True)):
                return

    def _write(self, record: JobRecord) -> bool:
        is_written = self._lease.write(record)
        if not is_written:
            self._watch(self.record)
        return is_written

    def _watch(self, record: JobRecord | None) -> JobRecord | None:
        if record is not None and record.state == "running":
            self.is_watched = True
        return record
