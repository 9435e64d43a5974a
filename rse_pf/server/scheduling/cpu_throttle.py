"""Emulate a server with fewer cores: a token bucket of CPU seconds delays the start of commands.

The bucket gets ``serving.emulated_cores`` CPU seconds per second, and loses the CPU seconds that the process
used, whatever for.  A command starts while the bucket is not below zero.  Nothing here sleeps: the caller
sets a timer for the returned time.
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["MIN_WAIT_S", "CpuThrottle"]

MIN_WAIT_S = 0.002  # shorter waits cost as much CPU time as a small server may use
_BURST_S = 0.02  # CPU seconds that may be used at once: some commands, so that a single one is not delayed


class CpuThrottle:
    """The bucket of one worker."""

    __slots__ = ("_at", "_burst_s", "_cores", "_cpu", "_cpu_s", "_level_s", "is_on")

    def __init__(
        self, cores: float, *, now: float, cpu: Callable[[], float], burst_s: float = _BURST_S
    ) -> None:
        """Begin with a full bucket.

        Args:
            cores: CPU seconds per second; 0 uses the cores that there are.
            now: Seconds, monotonic.
            cpu: Returns the CPU seconds that the process has used.
            burst_s: Size of the bucket, CPU seconds.
        """
        self.is_on = cores > 0
        self._cores = cores
        self._burst_s = self._level_s = burst_s
        self._at = now
        self._cpu = cpu
        self._cpu_s = cpu()

    def wait_s(self, now: float) -> float:
        """Return 0 if a command may start at *now* (s, monotonic), else how long to wait before asking
        again."""
        if not self._cores:
            return 0.0
        cpu_s = self._cpu()
        earned_s = (now - self._at) * self._cores
        self._level_s = min(self._burst_s, self._level_s + earned_s - (cpu_s - self._cpu_s))
        self._at, self._cpu_s = now, cpu_s
        return 0.0 if self._level_s >= 0 else max(MIN_WAIT_S, -self._level_s / self._cores)
