"""Identify a process by its pid and its start time, so that a re-used pid is never signalled.

Signals go through a process handle that is checked after it was opened.  A process that is gone is no error.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import resource
import select
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rse_pf.linux import die_with_parent

__all__ = [
    "STOP_TIMEOUT_S",
    "ProcessMark",
    "ended",
    "is_alive",
    "last_line",
    "mark_of",
    "send_signal",
    "spawn",
    "wait_ended",
]

_TAIL_BYTES = 8192
STOP_TIMEOUT_S = 10.0
"""A process that has not ended so long after it was asked to is killed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessMark:
    """One process of one boot of this machine.  ``began`` is opaque: clock ticks and boot."""

    pid: int
    began: str


def mark_of(pid: int) -> ProcessMark | None:
    """Return the mark of the process that has *pid* now; None if there is none, or it has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return None
    state, ticks = fields[0], fields[19]
    return None if state in "ZX" else ProcessMark(pid=pid, began=f"{ticks}@{boot}")


def is_alive(mark: ProcessMark) -> bool:
    """Return whether that very process still runs."""
    return mark_of(mark.pid) == mark


def send_signal(mark: ProcessMark, number: signal.Signals) -> bool:
    """Signal that very process; return False, and signal none, if it is gone."""
    with _handle(mark) as handle:
        if handle is None:
            return False
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(handle, number)
            return True
        return False


def wait_ended(mark: ProcessMark, timeout_s: float) -> bool:
    """Block until the process has ended, at most *timeout_s*; return whether it has."""
    with _handle(mark) as handle:
        if handle is None:
            return True
        return bool(select.select([handle], [], [], timeout_s)[0])


async def ended(mark: ProcessMark, timeout_s: float | None = None) -> bool:
    """Wait until the process has ended, at most *timeout_s*; return whether it has."""
    with _handle(mark) as handle:
        if handle is None:
            return True
        loop = asyncio.get_running_loop()
        over = asyncio.Event()
        loop.add_reader(handle, over.set)
        try:
            await asyncio.wait_for(over.wait(), timeout_s)
        except asyncio.TimeoutError:
            return False
        finally:
            loop.remove_reader(handle)
        return True


def spawn(
    command: Sequence[str],
    *,
    log: Path,
    folder: Path,
    dies_with_parent: bool,
    stdin: int = subprocess.DEVNULL,
) -> subprocess.Popen[bytes]:
    """Start *command* in a process group of its own, so that a terminal's Ctrl-C does not reach it.

    Not in a session of its own: where Linux groups by session (autogroup, a default of desktops), every
    session gets the same share of the processor, whatever the niceness of what runs in it.

    Args:
        command: Program and arguments.
        log: Where both of its output streams go; an earlier file is replaced.
        folder: Its working directory.
        dies_with_parent: Whether Linux kills it when the calling thread ends, however that ends.
        stdin: Nothing, or ``subprocess.PIPE``.
    """
    log.unlink(missing_ok=True)
    with log.open("ab") as output:  # it appends, so that the log may be cut short under it
        process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=stdin,
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=_apart(os.getpid() if dies_with_parent else None),
        )
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError):  # each robot needs two descriptors; the process may be gone already
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (most, most))
    return process


def last_line(log: Path) -> str:
    """Return the last line of *log* that is not empty and no hint, shortened to 300 letters."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - _TAIL_BYTES))
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    told = [line for line in lines if not line.startswith("hint:")]
    return (told or lines or [""])[-1][:300]


def _apart(parent: int | None) -> Callable[[], None]:
    """Return what a child does before its program: leave the group, and be killed with *parent*, if any."""

    def leave() -> None:
        os.setpgid(0, 0)
        if parent is not None and not die_with_parent(parent):
            os._exit(1)

    return leave


@contextlib.contextmanager
def _handle(mark: ProcessMark) -> Iterator[int | None]:
    """Yield a handle that is certain to mean the marked process, or None if it is gone."""
    try:
        handle = os.pidfd_open(mark.pid)
    except ProcessLookupError:
        yield None
        return
    try:
        yield handle if is_alive(mark) else None
    finally:
        os.close(handle)
