"""Slots to run a job, shared by all workers of a server: a pipe with one byte for each free slot.

Within a worker the order is that of `FairQueue`.  A slot is freed by `release`, or by the end of the server.

Source:
    The jobserver of GNU make.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

from rse_pf.fair_queue import FairQueue
from rse_pf.identity import RobotId

__all__ = ["JobSlots", "make_pipe"]

_POLL_S = 0.1


def make_pipe(count: int) -> tuple[int, int]:
    """Return both ends of a pipe that holds *count* slots."""
    ours, theirs = os.pipe()
    os.set_blocking(ours, False)
    os.write(theirs, b"j" * count)
    return ours, theirs


class JobSlots:
    """The slots as one worker sees them; used by its threads."""

    def __init__(self, pipe: tuple[int, int]) -> None:
        self._read, self._write = pipe
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
        """Free a slot."""
        os.write(self._write, b"j")

    def _take(self, robot: RobotId, ticket: object) -> bool:
        with self._lock:
            if self._queue.peek() is not ticket:
                return False
            try:
                is_taken = bool(os.read(self._read, 1))
            except BlockingIOError:
                return False
            if is_taken:
                self._queue.take()
                self._queue.release(robot)  # a slot is freed without a name: only the order counts
            return is_taken
