"""Slots to run a job, shared by all workers of a server: a record lock on one byte of a file for each slot.

The kernel releases the locks of a process that ends, so a worker that crashes gives its slots back.  Within a
worker the order is that of `FairQueue`.
"""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Callable

from rse_pf.identity import RobotId
from rse_pf.limits.fair_queue import FairQueue

__all__ = ["JobSlots", "make_slot_file"]

_POLL_S = 0.1  # between two tries to get a slot, since the kernel reports no released lock


def make_slot_file() -> int:
    """Return the descriptor of a file in memory, which every worker of a server inherits."""
    return os.memfd_create("job-slots")


class JobSlots:
    """The slots for the threads of one worker; at most one object in a process."""

    def __init__(self, file: int, count: int) -> None:
        """Take no slot yet.

        Args:
            file: Of `make_slot_file`; closing a descriptor of it would release the slots of this process.
            count: Number of slots of the server.
        """
        self._file, self._count = file, count
        self._taken: set[int] = set()
        """Slots of this worker, because the kernel grants a lock to the same process again."""
        self._queue: FairQueue[object] = FairQueue()
        self._lock = threading.Lock()

    def acquire(self, robot: RobotId, wait: Callable[[float], bool]) -> bool:
        """Wait for a slot for *robot*; False if *wait*, called with seconds to wait, returned False."""
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
        """Free a slot of this worker."""
        with self._lock:
            fcntl.lockf(self._file, fcntl.LOCK_UN, 1, self._taken.pop())

    def _take(self, robot: RobotId, ticket: object) -> bool:
        with self._lock:
            if self._queue.peek() is not ticket or not self._take_any():
                return False
            self._queue.take()
            self._queue.release(robot)  # a slot is freed without a name: only the order counts
            return True

    def _take_any(self) -> bool:
        for slot in range(self._count):
            if slot not in self._taken:
                try:
                    fcntl.lockf(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, slot)
                except (BlockingIOError, PermissionError):
                    continue  # another worker has it
                self._taken.add(slot)
                return True
        return False
