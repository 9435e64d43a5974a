"""Measure the memory of sandboxes, for machines on which the platform may not make memory cgroups.

The hard limits (address space, size of the scratch folder, refused system calls) hold without it.  The
watcher adds up what they bound one by one, and names the sandbox that is above the limit in all.
"""

from __future__ import annotations

import os
from pathlib import Path

from rse_pf.processes.linux import page_table_bytes, proportional_bytes, resident_bytes

__all__ = ["MemoryWatcher"]

_MIN_INTERVAL_S = 0.02  # between two measurements, which take CPU time themselves
_MAX_INTERVAL_S = 0.25  # between two measurements of sandboxes that are far below their limits
_MAX_GROWTH_BYTES_PER_S = 2 << 30  # a core fills new pages at most this fast


class MemoryWatcher:
    """Measure sandboxes so often that none exceeds its limit by more than a tenth unnoticed."""

    def __init__(self, memory_bytes: int, *, proc: Path = Path("/proc")) -> None:
        """Keep the limit.

        Args:
            memory_bytes: Memory of one sandbox: its processes' pages, page tables and scratch folder.
            proc: Where procfs is mounted.
        """
        self._limit = memory_bytes
        self._proc = proc
        self._next_s = _MAX_INTERVAL_S

    @property
    def interval_s(self) -> float:
        """Seconds until the next measurement: short if a sandbox was close to its limit at the last one."""
        return self._next_s

    def look(self, pids: list[int]) -> tuple[dict[int, str], float]:
        """Return the result of `find_excess`, and the seconds until the next measurement."""
        return self.find_excess(pids), self.interval_s

    def find_excess(self, pids: list[int]) -> dict[int, str]:
        """Return a reason for each sandbox above its limit; *pids* are the first processes of sandboxes."""
        reasons = {}
        least = self._limit
        for pid in pids:
            used = self.used_bytes(pid)
            if used > self._limit:
                reasons[pid] = f"it used {used} bytes of memory, the limit is {self._limit}"
            else:
                least = min(least, self._limit - used)
        self._next_s = max(_MIN_INTERVAL_S, min(_MAX_INTERVAL_S, least / _MAX_GROWTH_BYTES_PER_S))
        return reasons

    def used_bytes(self, pid: int) -> int:
        """Return the memory of a sandbox in bytes, 0 if it has ended.

        Pages that processes share count in proportion, but only near the limit, where that matters: adding
        them up takes milliseconds.
        """
        scratch = self._scratch_bytes(pid)
        at_least = resident_bytes(pid) + page_table_bytes(pid) + scratch
        if at_least <= self._limit // 2:
            return at_least
        return proportional_bytes(pid) + scratch

    def _scratch_bytes(self, pid: int) -> int:
        """Return the bytes in the scratch folder; 0 for plain users, where only its own limit is known."""
        try:
            state = os.statvfs(self._proc / str(pid) / "root/scratch")
        except OSError:
            return 0
        return (state.f_blocks - state.f_bfree) * state.f_frsize
