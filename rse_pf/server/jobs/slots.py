"""Limit the jobs that run on a server at the same time: each needs a slot, shared by all workers.

A slot is a record lock (fcntl) on one byte of a file in memory.  The kernel releases the locks of a process
that exits, so that the slots of a crashed worker become free.  Which job of a worker gets the next slot is
decided by a `FairQueue`: fair between tenants, then between the robots of a tenant.
"""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Callable

from rse_pf.identity import RobotId
from rse_pf.limits.fair_queue import FairQueue

__all__ = ["JobSlots", "make_slot_file"]

_POLL_S = 0.1  # seconds between two tries to get a slot, since the kernel does not report a released lock


def make_slot_file() -> int:
    """Return the descriptor of a new file in memory, for the locks; every worker of a server inherits it."""
    return os.memfd_create("job-slots")


class JobSlots:
    """Acquires and releases slots for the threads of one worker; a process may have only one such object."""

    def __init__(self, file: int, count: int) -> None:
        """Acquire no slot yet.

        Args:
            file: The result of `make_slot_file`; closing any descriptor of that file would release the slots
                of this process.
            count: Number of slots of the server.
        """
        self._file, self._count = file, count
        self._taken: set[int] = set()
        """Slots that this worker has: the kernel would grant such a lock to the same process once more."""
        self._queue: FairQueue[object] = FairQueue()
        self._lock = threading.Lock()

    def acquire(self, robot: RobotId, wait: Callable[[float], bool]) -> bool:
        """Wait for a slot for a job of *robot* and return True; `release` frees the slot.

        Between two tries, *wait* is called with a number of seconds, for which it waits.  If it returns
        False, no slot is acquired, and this method returns False.
        """
        ticket = object()
        with self._lock:
            self._queue.add(robot, ticket)
        try:
            while not self._take(robot, ticket):
                if not wait(_POLL_S):
                    return False
            return True
        finally:
            with self._lock:
                self._queue.remove(lambda waiting: waiting is ticket)

    def release(self) -> None:
        """Free one slot of this worker; which one does not matter."""
        with self._lock:
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, self._taken.pop())

    def _take(self, robot: RobotId, ticket: object) -> bool:
        """Acquire a free slot if *ticket* is next in the queue of this worker; return whether it was."""
        with self._lock:
            if self._queue.peek() is not ticket or not self._take_any():
                return False
            self._queue.take()
            self._queue.release(robot)  # the queue only decides the order; it need not know what still runs
            return True

    def _take_any(self) -> bool:
        """Lock the first free slot, and return True; return False if all slots are taken."""
        for slot in range(self._count):
            if slot not in self._taken:
                try:
                    fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, slot)
                except (BlockingIOError, PermissionError):
                    continue  # another worker has this slot
                self._taken.add(slot)
                return True
        return False
