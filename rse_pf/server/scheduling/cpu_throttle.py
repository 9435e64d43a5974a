"""Emulate a server with fewer cores: a token bucket of CPU seconds delays the start of commands.

1. The bucket of a worker gains ``serving.emulated_cores`` CPU seconds per second, up to its size `_BURST_S`.
2. It loses the CPU seconds that the process has used since the last call, for commands and all other work.
3. A command may start if the bucket is not below zero.  Otherwise `CpuThrottle.wait_s` returns the time until
   the bucket is refilled to zero, and the caller sets a timer.
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["MIN_WAIT_S", "CpuThrottle"]

MIN_WAIT_S = 0.002  # shortest wait in seconds: more frequent timers cost the CPU time of a small server
_BURST_S = 0.02  # size of the bucket in CPU seconds: several commands, so that a single one is not delayed


class CpuThrottle:
    """The token bucket of CPU seconds of one worker; ``is_on`` is whether it limits anything."""

    __slots__ = ("_at", "_burst_s", "_cores", "_cpu", "_cpu_s", "_level_s", "is_on")

    def __init__(
        self, cores: float, *, now: float, cpu: Callable[[], float], burst_s: float = _BURST_S
    ) -> None:
        """Begin with a full bucket.

        Args:
            cores: CPU seconds per second that the process may use; 0 is no limit.
            now: Present time, monotonic seconds.
            cpu: Returns the CPU seconds that the process has used since its start.
            burst_s: Size of the bucket in CPU seconds.
        """
        self.is_on = cores > 0
        self._cores = cores
        self._burst_s = self._level_s = burst_s
        self._at = now
        self._cpu = cpu
        self._cpu_s = cpu()

    def wait_s(self, now: float) -> float:
        """Return 0 if a command may start at *now* (monotonic s), else the seconds until the next try.

        These are at least `MIN_WAIT_S`.
        """
        if not self._cores:
            return 0.0
        cpu_s = self._cpu()
        earned_s = (now - self._at) * self._cores
        self._level_s = min(self._burst_s, self._level_s + earned_s - (cpu_s - self._cpu_s))
        self._at, self._cpu_s = now, cpu_s
        return 0.0 if self._level_s >= 0 else max(MIN_WAIT_S, -self._level_s / self._cores)
