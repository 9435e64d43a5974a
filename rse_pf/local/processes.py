"""Start, identify, signal and await processes, and rotate their logs.

A process is identified by its pid and its start time (`ProcessMark`), so that a process that got the pid of
an earlier one is never signalled.  Signals go through a process handle (pidfd), whose process is compared
with the mark after it was opened.  A process that has exited already is no error.
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
# Most log files of backend servers in a folder; the oldest are removed.  200 are hours of a crash loop.
_MAX_LOGS = 200
# Most bytes of all log files of backend servers together; the oldest are removed.
_MAX_LOGS_BYTES = 1 << 30
# Free bytes below which a full disk is named as the reason why a process has logged nothing.
_FULL_BYTES = 1 << 16
# Time between two searches for orphans, in seconds; an orphan is reaped at the second search that finds it,
# since by then a parent that waits for it has reaped it.
_REAP_EVERY_S = 2.0
_spawned: weakref.WeakValueDictionary[int, subprocess.Popen[bytes]] = weakref.WeakValueDictionary()
"""Children that `spawn` started, by pid; `reap_orphans` leaves them to the holder of the Popen object."""
# Time that a process gets to exit after the signal that asks it to, in seconds; then it is killed.
STOP_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessMark:
    """The identity of one process, which no other process has, also after a restart of this machine.

    ``began`` is its start time in clock ticks, and the id of the machine's boot.
    """

    pid: int
    began: str


def mark_of(pid: int) -> ProcessMark | None:
    """Return the mark of the process that has *pid* now; None if there is none, or it has exited."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return None
    state, ticks = fields[0], fields[19]
    return None if state in "ZX" else ProcessMark(pid=pid, began=f"{ticks}@{boot}")


def is_alive(mark: ProcessMark) -> bool:
    """Return whether the process of *mark* still runs."""
    return mark_of(mark.pid) == mark


def send_signal(mark: ProcessMark, number: signal.Signals) -> bool:
    """Send signal *number* to the process of *mark*; return False, and signal none, if it has exited."""
    with _handle(mark) as handle:
        if handle is None:
            return False
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(handle, number)
            return True
        return False


def wait_ended(mark: ProcessMark, timeout_s: float) -> bool:
    """Block until the process has exited, at most *timeout_s*; return whether it has."""
    with _handle(mark) as handle:
        if handle is None:
            return True
        return bool(select.select([handle], [], [], timeout_s)[0])


async def ended(mark: ProcessMark, timeout_s: float | None = None) -> bool:
    """Wait until the process has exited, at most *timeout_s* (None: without limit); return whether it has."""
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

    It stays in the session of this process: where Linux schedules by session (autogroup, a default of
    desktops), each session gets the same CPU time, and the niceness of processes would have no effect between
    sessions.  The process may open as many files as the system permits.

    Args:
        command: Program and arguments.
        log: File to which standard output and standard error of the process are appended.
        folder: Working directory of the process.
        dies_with_parent: Whether Linux kills the process when the calling thread ends, for whatever reason.
        stdin: Its standard input: ``subprocess.DEVNULL``, or ``subprocess.PIPE``.
    """
    with log.open("ab") as output:  # with append mode, `rotate_long_logs` may truncate the log meanwhile
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
    with contextlib.suppress(OSError):  # each robot needs two descriptors; the process may have exited
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (most, most))
    return process


async def reap_orphans() -> None:
    """Reap children that have exited and that `spawn` did not start, until cancelled.

    For the first process of a container without an init: Linux makes it the parent of every process whose own
    parent has exited.
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
    """Return the pids of the children of this process that have exited and are not reaped."""
    ended = set()
    for stat in Path("/proc").glob("[1-9]*/stat"):
        with contextlib.suppress(OSError):  # the process was reaped meanwhile
            state, parent = stat.read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()[:2]
            if state == "Z" and int(parent) == os.getpid():
                ended.add(int(stat.parent.name))
    return ended


class ServerProcess:
    """The process of one server, with its log and its announcement.

    The announcement is the JSON file that the server writes once it listens, with its pid and ports.  The
    process was started here, or adopted: then an earlier control plane started it, and it is no child of this
    process.  ``mark`` is None while there is no process.
    """

    def __init__(self, name: str, folder: Path) -> None:
        """Describe the process; its files are *name*.log and *name*.json in *folder*."""
        self.name = name
        self.log = folder / f"{name}.log"
        self.announcement = folder / f"{name}.json"
        self.mark: ProcessMark | None = None
        self._folder = folder
        self._child: subprocess.Popen[bytes] | None = None
        self._log_from = 0

    def prepare(self) -> None:
        """Remove the announcement of an earlier process; from now on read only new lines of the log."""
        self.announcement.unlink(missing_ok=True)
        self._log_from = log_size(self.log)

    def start(self, command: Sequence[str], *, dies_with_parent: bool) -> None:
        """Start *command* as `spawn` does, in place of the process before."""
        self.prepare()
        self.use(spawn(command, log=self.log, folder=self._folder, dies_with_parent=dies_with_parent))

    def use(self, child: subprocess.Popen[bytes]) -> None:
        """Use *child*, which was just started elsewhere, as the process."""
        self._child, self.mark = child, mark_of(child.pid)

    @property
    def pid(self) -> int:
        """The id of the process, also after it has exited; 0 if there was none."""
        if self._child is not None:
            return self._child.pid
        return 0 if self.mark is None else self.mark.pid

    def is_running(self) -> bool:
        """Return whether the process runs."""
        if self._child is not None:
            return self._child.poll() is None
        return self.mark is not None and is_alive(self.mark)

    def send(self, number: signal.Signals) -> bool:
        """Send signal *number* to the process; return False if there is none, or it has exited."""
        return self.mark is not None and send_signal(self.mark, number)

    async def wait_announced(self, timeout_s: float) -> dict[str, Any]:
        """Wait until the process has announced itself, and return the announcement, a JSON object.

        Raises:
            ConfigurationError: The process exited or wrote no announcement within *timeout_s*, or the
                announcement has the pid of another process.
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
        """Wait until the process has exited; return its exit code, or minus the signal that ended it.

        None if the process was adopted: Linux gives the exit code to its parent only.
        """
        if self.mark is not None:
            await ended(self.mark)
        return None if self._child is None else self._child.wait()

    async def stop(self, number: signal.Signals, timeout_s: float) -> None:
        """Send signal *number*, kill the process if it has not exited after *timeout_s*, and reap it."""
        if self.mark is not None and self.send(number):
            await ended(self.mark, timeout_s)
        self.kill()

    def kill(self) -> None:
        """Kill the process, if it runs, reap it, and remove its announcement."""
        self.send(signal.SIGKILL)
        if self._child is not None:
            self._child.kill()  # without a mark, `send` signalled nothing
            self._child.wait()
        self.announcement.unlink(missing_ok=True)

    def last_line(self) -> str:
        """Return the last line that this process logged.

        If it logged none, a sentence about the disk if that is full, else "".
        """
        last = last_line(self.log, self._log_from)
        return last or ("there is no space left on its disk" if _is_disk_full(self._folder) else "")

    def ending(self) -> str:
        """Return how the process ended, as the end of a sentence: ``ended with exit code 1``."""
        code = None if self._child is None else self._child.poll()
        return "ended" if code is None else f"ended with exit code {code}"

    def failed(self, problem: str) -> ConfigurationError:
        """Return an error whose message is the server's name, *problem*, and the last line that it logged."""
        last = self.last_line()
        return ConfigurationError(
            f"{self.name} {problem}{': ' if last else ''}{last}", hint=f"read its log {self.log}"
        )


def log_size(log: Path) -> int:
    """Return the size of the file *log* in bytes; 0 if it is missing."""
    try:
        return log.stat().st_size
    except OSError:
        return 0


def last_line(log: Path, start: int = 0) -> str:
    """Return the last line of *log* that is neither empty nor a hint, cut after 300 characters.

    If there are only hints, the last of them; "" if there is no line, or no file.

    Args:
        log: The file.
        start: Offset in bytes at which the process began to log; earlier lines are not read.  Ignored if the
            file is shorter, because the log was rotated.
    """
    try:
        with log.open("rb") as file:
            size = log.stat().st_size
            file.seek(max(start if start <= size else 0, size - _TAIL_BYTES))  # a shorter log was rotated
            text = file.read().decode("utf-8", "replace")
    except OSError:
        return ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    messages = [line for line in lines if not line.startswith("hint:")]
    return (messages or lines or [""])[-1][:300]


async def rotate_logs(folder: Path, max_bytes: int, in_use: Collection[str]) -> None:
    """Rotate long logs and remove the oldest logs of backend servers every 5 s, until cancelled.

    Args:
        folder: Folder of the files ``NAME.log``.
        max_bytes: Size above which a log is rotated.
        in_use: Names of the servers that run; the collection is read again each time.
    """
    while True:
        await asyncio.to_thread(rotate_long_logs, folder, max_bytes)
        await asyncio.to_thread(remove_old_logs, folder, list(in_use))
        await asyncio.sleep(_ROTATE_EVERY_S)


def rotate_long_logs(folder: Path, max_bytes: int) -> list[Path]:
    """Rotate every ``*.log`` of *folder* that is longer than *max_bytes*; return those logs.

    Copies and truncates as copytruncate of logrotate(8): the process that writes keeps its open file, and its
    earlier lines are in ``NAME.log.1``, which replaces the copy before.  A line that is written between the
    end of the copy and the truncation is lost.  A log that cannot be copied stays, and is tried the next
    time.
    """
    longer: list[Path] = []
    for log in sorted(folder.glob("*.log")):
        with contextlib.suppress(OSError):  # the log was removed, or the disk is full: try again next time
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
    """Remove the oldest logs of backend servers that have exited, and return the removed files.

    Only these logs grow in number: each new server has a new name, and so new files.

    Args:
        folder: Folder of the files ``server-N.log`` and ``server-N.log.1``.
        in_use: Names of the servers that run; their logs stay, but count.
        max_logs: Most files that stay.
        max_bytes: Most bytes of all files that stay together.
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
    """Copy *log*, also lines that are appended meanwhile, to *copy* in one step, and truncate *log*.

    If an OSError is raised, *copy* stays as it was.
    """
    part = copy.with_name(f"{TEMPORARY_PREFIX}{copy.name}")
    try:
        with log.open("rb") as source, part.open("wb") as target:
            os.fchmod(target.fileno(), os.fstat(source.fileno()).st_mode)
            shutil.copyfileobj(source, target)
            target.flush()
            shutil.copyfileobj(source, target)  # lines that were appended during the first pass
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
    """Return the function that a child process calls before it starts its program.

    It puts the child into a process group of its own and, unless *parent* is None, has Linux kill the child
    when *parent* exits; if *parent* has exited already, the child exits.
    """

    def leave() -> None:
        os.setpgid(0, 0)
        if parent is not None and not die_with_parent(parent):
            os._exit(1)

    return leave


@contextlib.contextmanager
def _handle(mark: ProcessMark) -> Iterator[int | None]:
    """Yield a process handle (pidfd) of the process of *mark*; None if it has exited."""
    try:
        handle = os.pidfd_open(mark.pid)
    except ProcessLookupError:
        yield None
        return
    try:
        yield handle if is_alive(mark) else None
    finally:
        os.close(handle)
