"""Read and change properties of Linux processes: their end, name, priority and limits.

A process that has exited is no error: its CPU seconds and its memory are 0, and its priority stays.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
from pathlib import Path

__all__ = [
    "PR_CAPBSET_DROP", "PR_SET_CHILD_SUBREAPER", "PR_SET_DUMPABLE", "PR_SET_NO_NEW_PRIVS", "PR_SET_SECCOMP",
    "be_killed_first", "close_other_descriptors", "cpu_seconds", "die_with_parent", "disk_free_percent",
    "limit_memory", "page_table_bytes", "prctl", "proportional_bytes",
    "raise_descriptor_limit", "resident_bytes", "run_as_batch", "set_process_name",
]  # fmt: skip

# Options of prctl(2), from <linux/prctl.h>.
PR_SET_DUMPABLE = 4  # whether other processes of the user may read the memory
PR_SET_SECCOMP = 22  # installs a filter of system calls
PR_CAPBSET_DROP = 24  # drops a capability for ever
PR_SET_CHILD_SUBREAPER = 36  # orphaned descendants become children of this process
PR_SET_NO_NEW_PRIVS = 38  # execve(2) never gives this process more privileges
_PR_SET_PDEATHSIG = 1  # signal for this process when the thread that started it ends
_PR_SET_NAME = 15  # name of this thread; of the main thread it is that of the process
_PRCTL = ctypes.CDLL(None, use_errno=True).prctl
"""The function prctl(2).  It is looked up once, at import, because a process that was just forked must not
take the locks that a look-up takes."""


def prctl(option: int, *arguments: int | bytes | ctypes.Structure) -> int:
    """Call prctl(2) and return its result; -1 after an error, whose errno `ctypes.get_errno` returns."""
    result: int = _PRCTL(option, *arguments, *[0] * (4 - len(arguments)))
    return result


def die_with_parent(parent: int | None = None) -> bool:
    """Have Linux kill this process when the thread that started it ends.

    Returns False if the process *parent* has exited already; with None this is not checked.
    """
    prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    return parent is None or os.getppid() == parent


def set_process_name(name: str) -> None:
    """Set the name that tools like top show for this process to the first 15 bytes of *name*."""
    prctl(_PR_SET_NAME, name.encode())


def raise_descriptor_limit() -> None:
    """Allow this process and its children as many open files as the system permits."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def be_killed_first() -> None:
    """Have Linux kill this process before others when the memory of the machine is short."""
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def limit_memory(memory_bytes: int, *, beyond_now: bool = False) -> None:
    """Limit the memory that this process may allocate to *memory_bytes*, and forbid core files.

    With *beyond_now*, the memory that it has allocated already is not counted.
    """
    if beyond_now:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[5])
        memory_bytes += pages * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_DATA, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def close_other_descriptors(keep: int) -> None:
    """Close all file descriptors that were inherited, except *keep*, standard input, output and error."""
    os.closerange(3, keep)
    os.closerange(max(3, keep + 1), 1 << 16)


def cpu_seconds(pid: int) -> float:
    """Return the user and system CPU seconds of *pid* and its reaped children, 0 if it has exited."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return sum(int(fields[i]) for i in (11, 12, 13, 14)) / os.sysconf("SC_CLK_TCK")


def disk_free_percent(folder: str = ".") -> float:
    """Return how much of the file system of *folder* is free, in percent, without what only root may use."""
    disk = os.statvfs(folder)
    return 100.0 * disk.f_bavail / max(1, disk.f_blocks)


def resident_bytes(pid: int) -> int:
    """Return the resident memory of the process *pid* in bytes, 0 if it has exited."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def page_table_bytes(pid: int) -> int:
    """Return the bytes of the page tables of the process *pid* in the kernel, 0 if it has exited."""
    return 1024 * _kilobytes(f"/proc/{pid}/status", "VmPTE")


def proportional_bytes(pid: int) -> int:
    """Return the bytes of memory of the process *pid*: its pages, its swap and its page tables.

    A page that several processes share counts in proportion.  If this user may not read that of *pid*, shared
    pages count in full, and pages of files do not count.  Returns 0 if the process has exited.
    """
    try:
        pages = _kilobytes(f"/proc/{pid}/smaps_rollup", "Pss", "SwapPss")
    except PermissionError:
        pages = _kilobytes(f"/proc/{pid}/status", "RssAnon", "RssShmem", "VmSwap")
    return 1024 * pages + page_table_bytes(pid)


def run_as_batch(pid: int, nice: int) -> None:
    """Set the scheduling policy of the process *pid* to SCHED_BATCH, and its niceness to *nice*.

    With this policy it waits for a processor rather than take one from a running process.  The niceness
    decides which part of a busy machine it gets; it is never lowered below the present one.  Threads that the
    process starts later inherit both.  Nothing happens if the process has exited.
    """
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, max(nice, os.getpriority(os.PRIO_PROCESS, 0)))
        if os.sched_getscheduler(pid) == os.SCHED_OTHER:
            os.sched_setscheduler(pid, os.SCHED_BATCH, os.sched_param(0))


def _kilobytes(file: str, *names: str) -> int:
    """Return the sum (kB) of the lines *names* of the procfs file *file*, 0 if its process has exited.

    Raises:
        PermissionError: This user may not read the file.
    """
    try:
        lines = Path(file).read_text().splitlines()
    except PermissionError:
        raise
    except OSError:
        return 0
    labels = {f"{name}:" for name in names}
    return sum(int(words[1]) for words in map(str.split, lines) if words and words[0] in labels)
