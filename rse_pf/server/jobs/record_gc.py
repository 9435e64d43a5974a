"""Garbage collection of job records that are unchanged for `RECORD_TTL_S`.

A record is marked with the time when it is first seen; the next renewal of a running job removes the mark.  A
record with an old mark is replaced by a tombstone and then deleted.  Each step is a compare-and-swap, so that
a running job keeps its record, and a robot that asks meanwhile gets the stored result or a new run.  Results
belong to the robot and are not deleted.
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

RECORD_TTL_S = 604_800.0  # a record that was not written for a week is deleted; its request then runs again
_PREFIX = "jobs/"
_LIST_INTERVAL_S = (
    3600.0  # between two listings of all records: each costs one request to the store for 1,000 records
)
_BATCH = 64  # records read in one call, which blocks the thread of a job


class RecordCollector:
    """Collects the records of one store, a few at a time, whenever a job has ended."""

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
            store: Shared by all servers; their collections do not disturb each other.
            ttl_s: A record that its owner did not write for this long is deleted.
            clock: Monotonic seconds.
            wall_clock: Unix seconds; may differ between machines by far less than *ttl_s*.
        """
        self._store = store
        self._ttl_s = ttl_s
        self._clock = clock
        self._wall_clock = wall_clock
        self._names: list[str] = []
        self._listed_s = float("-inf")
        self._lock = threading.Lock()

    def collect(self) -> int:
        """Read the next few records and return how many were deleted; blocks for the store.

        Returns 0 at once while another thread is here.  Records that fail are tried in the next round.
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
            return False  # the next round reads it again
        return True
