"""Forget the records of jobs that nobody asked for in a long time, also of those that nobody ended.

A record is marked with the time when it is first seen, by compare-and-swap; whoever works on the job takes
the mark away with its next renewal.  One whose mark is old becomes a tombstone first, again by
compare-and-swap, and then goes.  Promises that a job which lives keeps its record, that who asks meanwhile
gets the stored result or a new run, and to remove no result: those are the robot's.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from rse_pf.backend.jobs.lease import decode_record, encode_record, is_over, marked, tombstone
from rse_pf.errors import StoreError
from rse_pf.object_store import ObjectStore

__all__ = ["RecordCollector"]

_PREFIX = "jobs/"
_LIST_AGAIN_S = 3600.0
_AT_ONCE = 64
"""Records looked at in one turn: a worker has other things to do."""


class RecordCollector:
    """The records of one store, looked at a few at a time by whoever has just ended a job."""

    def __init__(
        self,
        store: ObjectStore,
        *,
        life_s: float,
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        """Look at nothing yet.

        Args:
            store: Shared by all servers; their sweeps do not disturb each other.
            life_s: ``serving.job_record_ttl_s``.
            clock: Monotonic seconds.
            wall_clock: Unix seconds; may differ between machines by far less than *life_s*.
        """
        self._store = store
        self._life_s = life_s
        self._clock = clock
        self._wall_clock = wall_clock
        self._names: list[str] = []
        self._listed_s = float("-inf")
        self._lock = threading.Lock()

    def turn(self) -> int:
        """Look at the next few records; return how many went.  Blocks for the store.

        One thread at a time; for others there is nothing to do.  What fails is left for later.
        """
        if not self._lock.acquire(blocking=False):
            return 0
        try:
            if not self._names and self._clock() - self._listed_s >= _LIST_AGAIN_S:
                self._listed_s = self._clock()
                self._names = [info.name for info in self._store.list(_PREFIX)]
            these, self._names = self._names[:_AT_ONCE], self._names[_AT_ONCE:]
            return sum(self._look(name) for name in these)
        except StoreError:
            return 0
        finally:
            self._lock.release()

    def _look(self, name: str) -> bool:
        try:
            data = self._store.get(name)
            record, now = decode_record(name, data), self._wall_clock()
            if not record.marked_s:
                self._store.compare_and_swap(name, data, encode_record(marked(record, now)))
                return False
            if not is_over(record, now, self._life_s):
                return False
            self._store.compare_and_swap(name, data, encode_record(tombstone(now)))
            self._store.delete(name)
        except StoreError:
            return False  # somebody else was quicker and knows better, or it is seen to next time
        return True
