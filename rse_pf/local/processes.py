"""Identify a process by its pid and its start time, so that a re-used pid is never signalled.

Signals go through a process handle that is checked after it was opened.  A process that is gone is no error.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import select
import shutil
import signal
import subprocess
import time
import weakref
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.errors import ConfigurationError
from rse_pf.processes.linux import die_with_parent
from rse_pf.storage.files import TEMPORARY_PREFIX

__all__ = [
    "STOP_TIMEOUT_S",
    "ProcessMark",
    "ServerProcess",
    "ended",
    "is_alive",
    "last_line",
    "log_size",
    "mark_of",
    "reap_orphans",
    "remove_old_logs",
    "rotate_logs",
    "rotate_long_logs",
    "send_signal",
    "spawn",
    "wait_ended",
]

# Bytes at the end of a log in which its last line is searched.
_TAIL_BYTES = 8192
# Time between two checks whether a process has announced itself, in seconds.
_POLL_S = 0.01
# Time between two checks of the sizes of logs, in seconds.
_ROTATE_EVERY_S = 5.0
# Logs of servers that are kept: hours of a crash loop.
_MAX_LOGS = 200
# Size of all logs of servers together.
_MAX_LOGS_BYTES = 1 << 30
# Free space below which a disk counts as full when a process has logged nothing.
_FULL_BYTES = 1 << 16
# Time between two searches for orphans, in seconds: any waiting parent reaps its child sooner.
_REAP_EVERY_S = 2.0
_spawned: weakref.WeakValueDictionary[int, subprocess.Popen[bytes]] = weakref.WeakValueDictionary()
"""Children of `spawn` by pid; the holder of a child reaps it, however late."""
# Time that a process gets to end after a request, in seconds; then it is killed.
STOP_TIMEOUT_S = 10.0


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
        log: Where both of its output streams go, behind what is there.
        folder: Its working directory.
        dies_with_parent: Whether Linux kills it when the calling thread ends, however that ends.
        stdin: Nothing, or ``subprocess.PIPE``.
    """
    with log.open("ab") as output:  # it appends, so that the log may be cut short under it
        process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=stdin,
            stdout=output,
            stderr=subprocess.STDOUT,
            preexec_fn=_child_setup(os.getpid() if dies_with_parent else None),
        )
    _spawned[process.pid] = process
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError):  # each robot needs two descriptors; the process may be gone already
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (most, most))
    return process


async def reap_orphans() -> None:
    """Reap ended children that this process did not start, until cancelled.

    Without an init, the first process of a container is the parent of every process whose own has ended.
    """
    before: set[int] = set()
    while True:
        running = {child.pid for ref in _spawned.valuerefs() if (child := ref()) and child.returncode is None}
        orphans = _ended_children() - running
        for pid in orphans & before:
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)
        before = orphans
        await asyncio.sleep(_REAP_EVERY_S)


def _ended_children() -> set[int]:
    """Return the pids of the children of this process that have ended and are not reaped."""
    ended = set()
    for stat in Path("/proc").glob("[1-9]*/stat"):
        with contextlib.suppress(OSError):  # it is gone
            state, parent = stat.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[:2]
            if state == "Z" and int(parent) == os.getpid():
                ended.add(int(stat.parent.name))
    return ended


class ServerProcess:
    """The process of one server with its log and announcement: started here, or adopted.

    An adopted process was started by an earlier control plane and is no child of this one.
    """

    def __init__(self, name: str, folder: Path) -> None:
        """Describe the process; its files in *folder* begin with *name*."""
        self.name = name
        self.log = folder / f"{name}.log"
        self.announcement = folder / f"{name}.json"
        self.mark: ProcessMark | None = None
        self._folder = folder
        self._child: subprocess.Popen[bytes] | None = None
        self._log_from = 0

    def prepare(self) -> None:
        """Forget the process before this one: its announcement, and which lines of the log are its own."""
        self.announcement.unlink(missing_ok=True)
        self._log_from = log_size(self.log)

    def start(self, command: Sequence[str], *, dies_with_parent: bool) -> None:
        """Start *command* as `spawn` does."""
        self.prepare()
        self.use(spawn(command, log=self.log, folder=self._folder, dies_with_parent=dies_with_parent))

    def use(self, child: subprocess.Popen[bytes]) -> None:
        """Take *child*, which was just started, for the process."""
        self._child, self.mark = child, mark_of(child.pid)

    @property
    def pid(self) -> int:
        """The id of the process, also of one that has ended; 0 if there was none."""
        if self._child is not None:
            return self._child.pid
        return 0 if self.mark is None else self.mark.pid

    def is_running(self) -> bool:
        """Return whether the process is there."""
        if self._child is not None:
            return self._child.poll() is None
        return self.mark is not None and is_alive(self.mark)

    def send(self, number: signal.Signals) -> bool:
        """Signal the process; return False if it is gone."""
        return self.mark is not None and send_signal(self.mark, number)

    async def wait_announced(self, timeout_s: float) -> dict[str, Any]:
        """Return the announcement, once the process has written it.

        Raises:
            ConfigurationError: The process ended or was not ready in time, or another one announced itself.
        """
        end = time.monotonic() + timeout_s
        while not self.announcement.exists():
            if not self.is_running():
                raise self.failed(self.ending())
            if time.monotonic() >= end:
                raise self.failed(f"was not ready within {timeout_s:g} s")
            await asyncio.sleep(_POLL_S)
        document: dict[str, Any] = json.loads(self.announcement.read_text(encoding="utf-8"))
        if self.mark is None or document["pid"] != self.mark.pid:
            started = "nothing" if self.mark is None else self.mark.pid
            raise self.failed(f"announced pid {document['pid']}, but was started as {started}")
        return document

    async def wait_over(self) -> int | None:
        """Wait for the end; return the exit code (negative: the signal), None if the process was adopted."""
        if self.mark is not None:
            await ended(self.mark)
        return None if self._child is None else self._child.wait()

    async def stop(self, number: signal.Signals, timeout_s: float) -> None:
        """Signal the process, and kill it if it has not ended after *timeout_s*."""
        if self.mark is not None and self.send(number):
            await ended(self.mark, timeout_s)
        self.kill()

    def kill(self) -> None:
        """Kill the process, if it is there, reap it, and remove its announcement."""
        self.send(signal.SIGKILL)
        if self._child is not None:
            self._child.kill()  # it may have ended before it had a mark
            self._child.wait()
        self.announcement.unlink(missing_ok=True)

    def last_line(self) -> str:
        """Return the last line that this process logged; if it has none on a full disk, the cause."""
        last = last_line(self.log, self._log_from)
        return last or ("there is no space left on its disk" if _is_disk_full(self._folder) else "")

    def ending(self) -> str:
        """Return how the process ended, as part of a sentence."""
        code = None if self._child is None else self._child.poll()
        return "ended" if code is None else f"ended with exit code {code}"

    def failed(self, problem: str) -> ConfigurationError:
        """Return the error that says *problem* happened, with the last line that the process logged."""
        last = self.last_line()
        return ConfigurationError(
            f"{self.name} {problem}{': ' if last else ''}{last}", hint=f"its log is {self.log}"
        )


def log_size(log: Path) -> int:
    """Return the length of *log* in bytes, 0 if it is missing."""
    try:
        return log.stat().st_size
    except OSError:
        return 0


def last_line(log: Path, start: int = 0) -> str:
    """Return the last line of *log* that is not empty and no hint, shortened to 300 letters.

    Args:
        log: The file.
        start: Lines before this byte are those of an earlier process.
    """
    try:
        with log.open("rb") as file:
            size = log.stat().st_size
            file.seek(max(start if start <= size else 0, size - _TAIL_BYTES))  # it may have been rotated
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    messages = [line for line in lines if not line.startswith("hint:")]
    return (messages or lines or [""])[-1][:300]


async def rotate_logs(folder: Path, max_bytes: int, in_use: Collection[str]) -> None:
    """Rotate the logs of *folder* periodically and remove the oldest of servers, until cancelled.

    Args:
        folder: With files ``NAME.log``.
        max_bytes: Length from which a log is rotated.
        in_use: Names of servers that run, as they come and go.
    """
    while True:
        await asyncio.to_thread(rotate_long_logs, folder, max_bytes)
        await asyncio.to_thread(remove_old_logs, folder, list(in_use))
        await asyncio.sleep(_ROTATE_EVERY_S)


def rotate_long_logs(folder: Path, max_bytes: int) -> list[Path]:
    """Rotate every ``*.log`` of *folder* that is longer than *max_bytes*; return those logs.

    Copies and truncates as copytruncate of logrotate(8): the process that writes keeps its descriptor, and
    the newest lines stay, in the log or in its one predecessor ``NAME.log.1``.  A line that is written
    between the end of the copy and the cut is lost.
    """
    longer: list[Path] = []
    for log in sorted(folder.glob("*.log")):
        with contextlib.suppress(OSError):  # it is gone, or the disk is full: try again next time
            if log.stat().st_size > max_bytes:
                _copy_and_cut(log, log.with_name(f"{log.name}.1"))
                longer.append(log)
    return longer


def remove_old_logs(
    folder: Path,
    in_use: Collection[str],
    *,
    max_logs: int = _MAX_LOGS,
    max_bytes: int = _MAX_LOGS_BYTES,
) -> list[Path]:
    """Remove the oldest logs of servers that have ended, and return them.

    A server's name is not used twice while a platform runs; all other processes have one log each.

    Args:
        folder: With files ``server-N.log`` and ``server-N.log.1``.
        in_use: Names of servers that run; their logs stay.
        max_logs: How many files stay at most.
        max_bytes: How long they are together at most.
    """
    ages = []
    for log in (*folder.glob("server-*.log"), *folder.glob("server-*.log.1")):
        with contextlib.suppress(OSError):
            about = log.stat()
            ages.append((about.st_mtime, about.st_size, log))
    removed, count, total = [], 0, 0
    for _, size, log in sorted(ages, reverse=True):
        count, total = count + 1, total + size
        if (count > max_logs or total > max_bytes) and log.name.partition(".log")[0] not in in_use:
            log.unlink(missing_ok=True)
            removed.append(log)
    return removed


def _copy_and_cut(log: Path, copy: Path) -> None:
    """Copy *log* to its end, also what is appended meanwhile, and cut it; the last copy stays until then."""
    part = copy.with_name(f"{TEMPORARY_PREFIX}{copy.name}")
    try:
        with log.open("rb") as source, part.open("wb") as target:
            os.fchmod(target.fileno(), os.fstat(source.fileno()).st_mode)
            shutil.copyfileobj(source, target)
            target.flush()
            shutil.copyfileobj(source, target)  # what came during the first pass and its end
            target.flush()
            os.replace(part, copy)
            os.truncate(log, 0)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def _is_disk_full(folder: Path) -> bool:
    try:
        about = os.statvfs(folder)
    except OSError:
        return False
    return about.f_bavail * about.f_frsize < _FULL_BYTES


def _child_setup(parent: int | None) -> Callable[[], None]:
    """Return what a child does before its program: leave the group, and be killed with *parent*, if any."""

    def leave() -> None:
        os.setpgid(0, 0)
        if parent is not None and not die_with_parent(parent):
            os._exit(1)

    return leave


@contextlib.contextmanager
def _handle(mark: ProcessMark) -> Iterator[int | None]:
    """Yield a handle of exactly the marked process, or None if it has ended."""
    try:
        handle = os.pidfd_open(mark.pid)
    except ProcessLookupError:
        yield None
        return
    try:
        yield handle if is_alive(mark) else None
    finally:
        os.close(handle)
