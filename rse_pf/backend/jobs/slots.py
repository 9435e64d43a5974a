"""Turns to run a job, shared by all workers of a server: a pipe with one byte for each turn.

Within a worker robots take turns (`job_turns`).  Promises that a turn which was taken comes back only by
`release`, or with the end of the server.

Source:
    The jobserver of GNU make.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

from rse_pf.backend.jobs.fair_queue import FairQueue, Who

__all__ = ["JobSlots", "make_pipe"]

_LOOK_AGAIN_S = 0.1


def make_pipe(count: int) -> tuple[int, int]:
    """Return both ends of a pipe that holds *count* turns."""
    ours, theirs = os.pipe()
    os.set_blocking(ours, False)
    os.write(theirs, b"j" * count)
    return ours, theirs


class JobSlots:
    """The turns as one worker sees them; used by its threads."""

    def __init__(self, pipe: tuple[int, int]) -> None:
        self._read, self._write = pipe
        self._line = FairQueue()
        self._lock = threading.Lock()

    def acquire(self, who: Who, rest: Callable[[float], bool]) -> bool:
        """Wait for a turn of *who*; False if *rest*, which waits so many seconds, says that it is off."""
        ticket = object()
        with self._lock:
            self._line.join(ticket, who)
        try:
            while not self._take(ticket):
                if not rest(_LOOK_AGAIN_S):
                    return False
            return True
        finally:
            with self._lock:
                self._line.leave(ticket)

    def release(self) -> None:
        """Give a turn back."""
        os.write(self._write, b"j")

    def _take(self, ticket: object) -> bool:
        with self._lock:
            if self._line.first() is not ticket:
                return False
            try:
                taken = bool(os.read(self._read, 1))
            except BlockingIOError:
                return False
            if taken:
                self._line.served(ticket)
            return taken
