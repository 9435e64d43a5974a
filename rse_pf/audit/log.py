"""The files of the audit log: append to one log, and read any.

A writer appends to ``WHO.jsonl``; a file that has grown large is renamed to ``WHO.NUMBER.jsonl``.  Nothing
here changes or removes a line, but whoever may write the folder can; Object Lock in S3 protects the copies
there.  Recording never waits for a disk; entries are durable when `AuditLog.flush` returns True.  While the
disk is full, entries wait in memory; the number of those that did not fit is recorded once there is space
again.
"""

from __future__ import annotations

import errno
import fcntl
import os
import re
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rse_pf.audit.entry import Entry, Value, entry_line, parse_entry
from rse_pf.errors import ConfigurationError
from rse_pf.storage.files import OWNER_ONLY, sync_folder

__all__ = [
    "CONTROL_PLANE",
    "OPERATOR",
    "SYNC_S",
    "AuditLog",
    "audit_folder",
    "log_files",
    "log_names",
    "read_entries",
    "read_logs",
    "record_once",
]

CONTROL_PLANE = "control-plane"
"""Name of the log of a local platform's control plane."""
OPERATOR = "operator"
"""Name of the log of operators' commands."""
SYNC_S = 0.1
"""Time between two writes to the disk.  A worker waits as long before it sends entries to its supervisor, so
a machine that fails loses the entries of 0.2 s at most."""
_RETRY_S = 1.0
"""Time between two attempts to write to a disk that is full."""
_GAP = "log.gap"
"""Action of an entry that reports the number of lost entries."""
_MAX_FILE_BYTES = 16 << 20
"""A file that is longer is renamed before the next line; it exceeds this by one line at most."""
_MAX_WAITING = 20_000
"""Entries that wait for the disk; further ones are lost, and counted."""
_MAX_LINE_BYTES = 1 << 18
"""Above the size of any entry: 64 details of two strings of 200 characters, six bytes each at worst."""
_FILE = re.compile(r"(?P<who>[A-Za-z0-9_-]{1,64})(\.(?P<number>\d{12}))?\.jsonl")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")


class AuditLog:
    """A writer of the log *who* in *folder*; several processes may write the same log."""

    def __init__(
        self,
        folder: Path,
        who: str,
        *,
        wall_clock: Callable[[], float],
        on_problem: Callable[[str], None],
        max_bytes: int = _MAX_FILE_BYTES,
    ) -> None:
        """Describe a log; nothing is opened yet.

        Args:
            folder: Created with mode 0700 if it is missing.
            who: Names the writer; letters that a file name may not have become ``_``.
            wall_clock: Unix seconds.
            on_problem: Called with a sentence, in any thread, when writing begins to fail, and when the log
                is closed without entries that could not be written.
            max_bytes: A file that is longer is renamed before the next line.
        """
        self.who = _UNSAFE.sub("_", who)[:64]
        self._on_problem = on_problem
        self._folder = folder
        self._path = folder / f"{self.who}.jsonl"
        self._wall_clock = wall_clock
        self._max_bytes = max_bytes
        self._waiting: deque[Entry] = deque()
        self._lost = 0
        self._fd = -1
        self._is_line_cut = False
        self._is_failing = False
        self._buffer_lock, self._writing = threading.Lock(), threading.Lock()
        self._wake, self._closed = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> AuditLog:
        """Open the file; raises ConfigurationError if it cannot be written."""
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._open_file()
        except OSError as error:
            raise ConfigurationError(
                f"cannot write the audit log in {self._folder}: {error.strerror}",
                hint="make the folder writable, or name another with --audit",
            ) from error
        return self

    def start(self) -> None:
        """Write by a thread of its own from now on, `SYNC_S` after the first entry of each batch."""
        self._thread = threading.Thread(target=self._write_on, name="audit", daemon=True)
        self._thread.start()

    def record(self, action: str, subject: str = "", /, **detail: Value) -> None:
        """Record an action of this writer with the next flush.

        Args:
            action: What was done, such as ``robot.enrolled``.
            subject: The object of the action.
            **detail: Names, numbers and reasons.
        """
        now = self._wall_clock()
        self.add([Entry(time=now, actor=self.who, action=action, subject=subject, detail=detail)])

    def add(self, entries: Iterable[Entry]) -> None:
        """Record *entries* with the next flush; those beyond the limit of memory are lost, and counted."""
        with self._buffer_lock:
            for entry in entries:
                if len(self._waiting) >= _MAX_WAITING:
                    self._lost += 1
                else:
                    self._waiting.append(entry)
        self._wake.set()

    def flush(self) -> bool:
        """Write the waiting entries, and return whether all are on the disk; the others stay in memory.

        If only `fsync` fails, entries are written again, and may be in the log twice.
        """
        with self._writing:
            try:
                while batch := self._next_batch():
                    self._write(batch)
            except OSError as error:
                if not self._is_failing:
                    self._on_problem(f"the audit log of {self.who} cannot be written: {error.strerror}")
                self._is_failing = True
            else:
                self._is_failing = False
            return not self._is_failing

    def close(self) -> bool:
        """Write what waits, close the file, and return whether the last write succeeded."""
        self._closed.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
        is_written = self.flush()
        if not is_written:
            count = len(self._waiting) + self._lost
            self._on_problem(f"the audit log of {self.who} ends without its last {count} entries")
        os.close(self._fd)
        return is_written

    def _next_batch(self) -> list[Entry]:
        """Return the waiting entries, followed by one with the number of lost entries if there are any."""
        with self._buffer_lock:
            batch = list(self._waiting)
            if self._lost:
                detail = {"entries": self._lost}
                batch.append(Entry(time=self._wall_clock(), actor=self.who, action=_GAP, detail=detail))
            return batch

    def _write(self, batch: list[Entry]) -> None:
        """Append entries of *batch* until the file is full, and forget those that are on the disk."""
        if self._is_full():
            self._rotate()
        count = 0
        try:
            while count < len(batch) and not (count and self._is_full()):
                self._append(entry_line(batch[count]))
                count += 1
        finally:
            os.fsync(self._fd)
            for entry in batch[:count]:
                self._forget(entry)

    def _is_full(self) -> bool:
        return os.fstat(self._fd).st_size > self._max_bytes

    def _forget(self, written: Entry) -> None:
        with self._buffer_lock:
            if self._waiting and self._waiting[0] is written:
                self._waiting.popleft()
            else:
                self._lost -= int(written.detail["entries"] or 0)

    def _append(self, line: bytes) -> None:
        """Append one line by one call, so that lines of several writers do not mix."""
        if self._is_line_cut:  # what was written of it stays a line of its own, which no reader takes
            line = b"\n" + line
        count = os.write(self._fd, line)
        if count < len(line):
            self._is_line_cut = True
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._is_line_cut = False

    def _rotate(self) -> None:
        """Rename the file, unless another writer has done so, and go on in a new one."""
        full = self._fd
        fcntl.flock(full, fcntl.LOCK_EX)
        try:
            if self._path.exists() and os.path.samestat(os.fstat(full), self._path.stat()):
                numbers = [int(match["number"] or 0) for match in _files_in(self._folder, self.who).values()]
                self._path.rename(self._folder / f"{self.who}.{max(numbers) + 1:012d}.jsonl")
        finally:
            fcntl.flock(full, fcntl.LOCK_UN)
        self._open_file()
        os.close(full)

    def _open_file(self) -> None:
        fd = os.open(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, OWNER_ONLY)
        size = os.fstat(fd).st_size
        self._is_line_cut = size > 0 and os.pread(fd, 1, size - 1) != b"\n"  # a writer was killed
        self._fd = fd
        sync_folder(self._folder)

    def _write_on(self) -> None:
        while not self._closed.is_set():
            self._wake.wait()
            self._closed.wait(_RETRY_S if self._is_failing else SYNC_S)
            self._wake.clear()
            if not self.flush():
                self._wake.set()


def record_once(
    folder: Path,
    who: str,
    action: str,
    subject: str = "",
    *,
    wall_clock: Callable[[], float],
    **detail: Value,
) -> None:
    """Open the log, write one entry and close it; raises ConfigurationError if it cannot be written."""
    problems: list[str] = []
    log = AuditLog(folder, who, wall_clock=wall_clock, on_problem=problems.append).open()
    log.record(action, subject, **detail)
    if not log.close():
        raise ConfigurationError(problems[0], hint="free some space in the folder of the platform")


def audit_folder(state: Path) -> Path:
    """Return the folder of the audit logs of the platform with the state folder *state*."""
    return state / "audit"


def log_names(folder: Path) -> list[str]:
    """Return the names of all logs in *folder*."""
    return sorted({match["who"] for match in _files_in(folder).values()})


def log_files(folder: Path, who: str) -> list[Path]:
    """Return the files of one log, oldest first."""
    files = _files_in(folder, who)
    return sorted(files, key=lambda path: files[path]["number"] or "~")


def read_entries(path: Path) -> Iterator[Entry]:
    """Yield the entries of one file; a line that is not an entry is skipped."""
    with path.open("rb") as file:
        while line := file.readline(_MAX_LINE_BYTES):
            entry = parse_entry(line)
            if entry is not None:
                yield entry


def read_logs(paths: Iterable[Path]) -> list[tuple[str, Entry]]:
    """Return the name of the log and the entry for all entries of *paths*, in the order of their time."""
    rows = [(path.name.partition(".")[0], entry) for path in paths for entry in read_entries(path)]
    return sorted(rows, key=lambda row: row[1].time)


def _files_in(folder: Path, who: str = "") -> dict[Path, re.Match[str]]:
    """Return the files of the log *who*, or of all, with the parts of their names."""
    matches = {path: _FILE.fullmatch(path.name) for path in (folder.iterdir() if folder.is_dir() else ())}
    return {path: match for path, match in matches.items() if match and who in ("", match["who"])}
