"""Garbage collection of job records that are unchanged for `RECORD_TTL_S`.

1. A collector that reads a record without a mark writes the present time into it as a mark (``marked_s``).
   The next renewal of a running job removes the mark.
2. A record whose mark is older than `RECORD_TTL_S` is replaced by a tombstone (state ``swept``), and deleted.

Each write is a compare-and-swap, so that a running job keeps its record, and a robot that requests the job
meanwhile gets the stored result or a new run.  Results are objects of the robot and are not deleted.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import msgspec

from rse_pf.errors import StoreError
from rse_pf.server.jobs.lease import JobRecord, decode_record
from rse_pf.storage.lease import Lease
from rse_pf.storage.object_store import ObjectStore

__all__ = ["RECORD_TTL_S", "RecordCollector"]

RECORD_TTL_S = 604_800.0  # seconds without a write (a week) after which a record is deleted
_PREFIX = "jobs/"  # of the object names of all records
# Seconds between two listings of all records: a listing costs one request to the store for 1,000 records.
_LIST_INTERVAL_S = 3600.0
_BATCH = 64  # records read in one call of `collect`, which blocks the thread of a job that has ended


class RecordCollector:
    """Deletes old records of jobs, a few at a time, whenever a job of this worker has ended."""

    def __init__(
        self,
        store: ObjectStore,
        *,
        ttl_s: float,
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        """Read nothing yet.

        Args:
            store: The object store, shared by all servers; several servers may collect at the same time.
            ttl_s: Seconds for which a record must be unchanged before it is deleted.
            clock: Returns monotonic seconds.
            wall_clock: Returns Unix seconds; the difference between machines must be far less than *ttl_s*.
        """
        self._store = store
        self._ttl_s = ttl_s
        self._clock = clock
        self._wall_clock = wall_clock
        self._names: list[str] = []
        self._listed_s = float("-inf")
        self._lock = threading.Lock()

    def collect(self) -> int:
        """Read the next `_BATCH` records, and return how many were deleted; blocks on the store.

        Returns 0 at once if another thread collects, or if the last listing was read and is not an hour old.
        A record for which the store fails is tried again after the next listing.
        """
        if not self._lock.acquire(blocking=False):
            return 0
        try:
            if not self._names and self._clock() - self._listed_s >= _LIST_INTERVAL_S:
                self._listed_s = self._clock()
                self._names = [info.name for info in self._store.list(_PREFIX)]
            batch, self._names = self._names[:_BATCH], self._names[_BATCH:]
            return sum(self._collect(name) for name in batch)
        except StoreError:
            return 0
        finally:
            self._lock.release()

    def _collect(self, name: str) -> bool:
        """Mark or delete one record by the rule of this module; return whether it was deleted."""
        lease = Lease(self._store, name, decode_record, self._clock)
        try:
            record, now = lease.read(), self._wall_clock()
            if record is None:
                return False
            if not record.marked_s:
                lease.write(msgspec.structs.replace(record, marked_s=now))
                return False
            if now - record.marked_s < self._ttl_s:
                return False
            if not lease.write(JobRecord(state="swept", owner="", marked_s=now)):
                return False
            self._store.delete(name)
        except StoreError:
            return False  # the record is read again after the next listing
        return True
