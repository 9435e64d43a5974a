"""Emulate a server of a fixed size: a bucket of CPU seconds gates the start of commands.

A server of size S may use S CPU seconds per second; the bucket is drained by what the process
really used, so the gate is honest whatever the work was.  Promises never to sleep or read a clock:
the caller asks, and waits as long as it is told.
"""

from __future__ import annotations

__all__ = ["MIN_WAIT_S", "CpuThrottle"]

MIN_WAIT_S = 0.002
"""Measured: with shorter waits, the waiting itself used up the budget of a small server."""


class CpuThrottle:
    """The bucket of one worker; ``size`` 0 means no gate."""

    __slots__ = ("_at", "_burst_s", "_cpu_s", "_level_s", "_size")

    def __init__(self, size: float, burst_s: float, *, now: float, cpu_s: float) -> None:
        self._size = size
        self._burst_s = burst_s
        self._level_s = burst_s
        self._at = now
        self._cpu_s = cpu_s

    @property
    def is_on(self) -> bool:
        """Whether this server emulates a size at all."""
        return self._size > 0

    def wait_s(self, now: float, cpu_s: float) -> float:
        """Return 0 if a command may start at *now*, else how long to wait before asking again.

        Args:
            now: Seconds, monotonic.
            cpu_s: CPU seconds that the process has used since it began.
        """
        if not self.is_on:
            return 0.0
        earned = (now - self._at) * self._size
        self._level_s = min(self._burst_s, self._level_s + earned - (cpu_s - self._cpu_s))
        self._at, self._cpu_s = now, cpu_s
        if self._level_s >= 0:
            return 0.0
        return max(MIN_WAIT_S, -self._level_s / self._size)
