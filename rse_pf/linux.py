"""Small facts of Linux about processes: die with the parent, priority, open files, CPU seconds, memory.

Promises to raise nothing for a process that is gone, and to change no process but its own and its children.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
from pathlib import Path

__all__ = [
    "call_this_process", "cpu_seconds", "die_with_parent", "raise_descriptor_limit", "resident_bytes",
    "step_back",
]  # fmt: skip

_PR_SET_PDEATHSIG = 1
_PR_SET_NAME = 15
_LOWEST = 19


def die_with_parent(parent: int) -> bool:
    """Ask Linux to kill this process when *parent* dies; False if it died already."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent


def call_this_process(name: str) -> None:
    """Let tools like top show *name* for this process, its first 15 bytes."""
    ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)


def raise_descriptor_limit() -> None:
    """Allow this process and its children as many open files as the system lets it."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def cpu_seconds(pid: int) -> float:
    """Return the user and system CPU seconds of *pid* and its reaped children, 0 if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return sum(int(fields[i]) for i in (11, 12, 13, 14)) / os.sysconf("SC_CLK_TCK")


def resident_bytes(pid: int) -> int:
    """Return the resident memory of *pid*, 0 if it is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def step_back(pid: int) -> None:
    """Let *pid* (0: this process) run only when nothing else wants to.

    A parent that does it right after the start spares its other children the imports of the new one: a second
    of CPU for a job.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, _LOWEST)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))
