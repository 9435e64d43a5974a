"""Turns to run a job, shared by all workers of a server: a pipe with one byte for each turn.

Within a worker turns are given in the order of asking.  Promises that a turn which was taken comes back only
by `release`, or with the end of the server.

Source:
    The jobserver of GNU make.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable

__all__ = ["Slots", "make_pipe"]

_LOOK_AGAIN_S = 0.1


def make_pipe(count: int) -> tuple[int, int]:
    """Return both ends of a pipe that holds *count* turns."""
    ours, theirs = os.pipe()
    os.set_blocking(ours, False)
    os.write(theirs, b"j" * count)
    return ours, theirs


class Slots:
    """The turns as one worker sees them; used by its threads."""

    def __init__(self, pipe: tuple[int, int]) -> None:
        self._read, self._write = pipe
        self._line: deque[object] = deque()

    def acquire(self, rest: Callable[[float], bool]) -> bool:
        """Wait for a turn; False if *rest*, which waits for so many seconds, says that it is off."""
        ticket = object()
        self._line.append(ticket)
        try:
            while not (self._line[0] is ticket and self._take()):
                if not rest(_LOOK_AGAIN_S):
                    return False
            return True
        finally:
            self._line.remove(ticket)

    def release(self) -> None:
        """Give a turn back."""
        os.write(self._write, b"j")

    def _take(self) -> bool:
        try:
            return bool(os.read(self._read, 1))
        except BlockingIOError:
            return False
