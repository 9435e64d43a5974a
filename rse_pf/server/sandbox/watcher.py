"""Measure the memory of sandboxes on machines where the platform cannot make memory cgroups.

Linux limits address space and scratch folder of each sandbox separately (`isolation`).  The watcher adds up
pages, page tables and scratch folder, and names the sandboxes whose sum is above the limit; the zygote kills
them.
"""

from __future__ import annotations

import os
from pathlib import Path

from rse_pf.processes.linux import page_table_bytes, proportional_bytes, resident_bytes

__all__ = ["MemoryWatcher"]

_MIN_INTERVAL_S = 0.02  # shortest time between two measurements, each of which takes CPU time
_MAX_INTERVAL_S = 0.25  # longest time between two measurements, while all sandboxes are far below the limit
_MAX_GROWTH_BYTES_PER_S = 2 << 30  # assumed fastest growth of a sandbox: one core fills new pages no faster


class MemoryWatcher:
    """Find the sandboxes that use more memory than their limit.

    The time to the next measurement is that in which the sandbox with the least free memory can reach its
    limit, but at least `_MIN_INTERVAL_S`; in that time a sandbox can exceed its limit by 41 MiB at most.
    """

    def __init__(self, memory_bytes: int, *, proc: Path = Path("/proc")) -> None:
        """Store the limit.

        Args:
            memory_bytes: Limit of one sandbox in bytes, for its pages, page tables and scratch folder.
            proc: Folder in which procfs is mounted.
        """
        self._limit = memory_bytes
        self._proc = proc
        self._next_s = _MAX_INTERVAL_S

    @property
    def interval_s(self) -> float:
        """Seconds until the next measurement, 0.02 to 0.25: less if a sandbox was close to its limit."""
        return self._next_s

    def look(self, pids: list[int]) -> tuple[dict[int, str], float]:
        """Measure all sandboxes; return the result of `find_excess`, and `interval_s`."""
        return self.find_excess(pids), self.interval_s

    def find_excess(self, pids: list[int]) -> dict[int, str]:
        """Measure the sandboxes with the process ids *pids*, and set `interval_s`.

        Returns:
            For the process id of each sandbox above the limit, a sentence with its memory and the limit.
        """
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
        """Return the memory of the sandbox with process id *pid* in bytes, 0 if it has exited.

        Up to half of the limit, pages that it shares with other processes count in full; above that, in
        proportion to the number of these processes, which takes milliseconds to measure.
        """
        scratch = self._scratch_bytes(pid)
        at_least = resident_bytes(pid) + page_table_bytes(pid) + scratch
        if at_least <= self._limit // 2:
            return at_least
        return proportional_bytes(pid) + scratch

    def _scratch_bytes(self, pid: int) -> int:
        """Return the bytes used in the scratch folder of a sandbox.

        It is 0 if the process has exited, or if this process may not read the folder, as without root.
        """
        try:
            state = os.statvfs(self._proc / str(pid) / "root/scratch")
        except OSError:
            return 0
        return (state.f_blocks - state.f_bfree) * state.f_frsize
