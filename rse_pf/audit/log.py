"""The files of the audit log: append entries to the log of one writer, and read logs.

The writer with the name WHO appends to the file ``WHO.jsonl``; a file above 16 MiB is renamed to
``WHO.NUMBER.jsonl``.  This module never changes or removes a line.  An account that may write in the folder
can do so; the copies in S3 are protected by Object Lock.

`AuditLog.record` never waits for the disk: entries are durable when `AuditLog.flush` returns True.  While the
disk is full, up to 20,000 entries wait in memory.  Further entries are lost, and their number is recorded
when there is space again.
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
"""Seconds between two writes of a log to the disk.  A worker waits as long before it sends entries to its
supervisor, so that the failure of a machine loses the entries of the last 0.2 s at most."""
_RETRY_S = 1.0
"""Seconds between two attempts to write to the disk after a write has failed, such as on a full disk."""
_GAP = "log.gap"
"""Action of an entry that reports the number of lost entries."""
_MAX_FILE_BYTES = 16 << 20
"""Size in bytes above which a file is renamed before the next line is written to a new file."""
_MAX_WAITING = 20_000
"""Largest number of entries that wait in memory for the disk; further entries are lost, and counted."""
_MAX_LINE_BYTES = 1 << 18
"""Largest part of a line in bytes that is read at a time.  It is above the size of any entry: 64 details of
two strings of 200 characters, each encoded in six bytes at worst, are 153,600 bytes."""
_FILE = re.compile(r"(?P<who>[A-Za-z0-9_-]{1,64})(\.(?P<number>\d{12}))?\.jsonl")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")  # characters that the name of a log must not contain


class AuditLog:
    """A writer of one log in a folder; several processes may write the same log.

    Attributes:
        who: Name of the log.
    """

    def __init__(
        self,
        folder: Path,
        who: str,
        *,
        wall_clock: Callable[[], float],
        on_problem: Callable[[str], None],
        max_bytes: int = _MAX_FILE_BYTES,
    ) -> None:
        """Prepare a log; no file is opened before `open`.

        Args:
            folder: Folder of the files; `open` creates it with mode 0700 if it is missing.
            who: Name of the log.  Every character but ASCII letters, digits, ``_`` and ``-`` is replaced by
                ``_``, and the name is cut to 64 characters.
            wall_clock: Returns Unix time in seconds.
            on_problem: Called with a sentence when writing begins to fail, and when the log is closed while
                entries are not written; possibly in the thread of `start`.
            max_bytes: Size in bytes above which a file is renamed before the next line is written.
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
        """Create the folder if it is missing, open the file, and return this object.

        Raises:
            ConfigurationError: The folder or the file cannot be written.
        """
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
        """Start a thread that writes waiting entries to the file, `SYNC_S` after the first of them."""
        self._thread = threading.Thread(target=self._write_on, name="audit", daemon=True)
        self._thread.start()

    def record(self, action: str, subject: str = "", /, **detail: Value) -> None:
        """Add an entry with the present time and this log's name as the actor; the next flush writes it.

        Args:
            action: What was done, such as ``robot.enrolled``.
            subject: On what the action was done, such as a robot.
            **detail: Further names, numbers and reasons.
        """
        now = self._wall_clock()
        self.add([Entry(time=now, actor=self.who, action=action, subject=subject, detail=detail)])

    def add(self, entries: Iterable[Entry]) -> None:
        """Add *entries* for the next flush; beyond 20,000 waiting entries, they are lost and counted."""
        with self._buffer_lock:
            for entry in entries:
                if len(self._waiting) >= _MAX_WAITING:
                    self._lost += 1
                else:
                    self._waiting.append(entry)
        self._wake.set()

    def flush(self) -> bool:
        """Write the waiting entries to the disk, and return whether all of them were written.

        Entries that could not be written stay in memory for the next flush.  If the entries were written but
        fsync(2) failed, they are written again, and are in the log twice.
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
        """Write the waiting entries, close the file, and return whether all entries were written."""
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
        """Return the waiting entries, which stay in memory, and an entry `_GAP` if entries were lost."""
        with self._buffer_lock:
            batch = list(self._waiting)
            if self._lost:
                detail = {"entries": self._lost}
                batch.append(Entry(time=self._wall_clock(), actor=self.who, action=_GAP, detail=detail))
            return batch

    def _write(self, batch: list[Entry]) -> None:
        """Append entries of *batch* until the file is full, and remove those on the disk from the memory.

        If the file was full before, it is renamed first.

        Raises:
            OSError: The file cannot be written.
        """
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
        """Append a line by one write(2), so that lines of several processes do not mix; raises OSError."""
        if self._is_line_cut:  # end the cut line, which readers skip
            line = b"\n" + line
        count = os.write(self._fd, line)
        if count < len(line):
            self._is_line_cut = True
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._is_line_cut = False

    def _rotate(self) -> None:
        """Rename the full file, unless another process has done so, and open a new one; raises OSError."""
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
        self._is_line_cut = size > 0 and os.pread(fd, 1, size - 1) != b"\n"  # a killed writer cut the line
        self._fd = fd
        sync_folder(self._folder)

    def _write_on(self) -> None:
        """Flush after new entries, and again after a failure, until the log is closed; runs in the thread."""
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
    """Open the log *who* in *folder*, write one entry, and close the log.

    Args:
        folder: Folder of the audit logs.
        who: Name of the log, and actor of the entry.
        action: What was done.
        subject: On what the action was done.
        wall_clock: Returns Unix time in seconds.
        **detail: Further names, numbers and reasons.

    Raises:
        ConfigurationError: The entry cannot be written.
    """
    problems: list[str] = []
    log = AuditLog(folder, who, wall_clock=wall_clock, on_problem=problems.append).open()
    log.record(action, subject, **detail)
    if not log.close():
        raise ConfigurationError(problems[0], hint="free some space in the folder of the platform")


def audit_folder(state: Path) -> Path:
    """Return the folder of the audit logs of the platform whose files are in the folder *state*."""
    return state / "audit"


def log_names(folder: Path) -> list[str]:
    """Return the sorted names of all logs in *folder*; empty if the folder does not exist."""
    return sorted({match["who"] for match in _files_in(folder).values()})


def log_files(folder: Path, who: str) -> list[Path]:
    """Return the files of the log *who* in *folder*, oldest first; empty if there are none."""
    files = _files_in(folder, who)
    return sorted(files, key=lambda path: files[path]["number"] or "~")


def read_entries(path: Path) -> Iterator[Entry]:
    """Yield the entries of the file *path* in order; lines that are not valid entries are skipped."""
    with path.open("rb") as file:
        while line := file.readline(_MAX_LINE_BYTES):
            entry = parse_entry(line)
            if entry is not None:
                yield entry


def read_logs(paths: Iterable[Path]) -> list[tuple[str, Entry]]:
    """Read all entries of the files *paths*; return each with the name of its log, sorted by time."""
    rows = [(path.name.partition(".")[0], entry) for path in paths for entry in read_entries(path)]
    return sorted(rows, key=lambda row: row[1].time)


def _files_in(folder: Path, who: str = "") -> dict[Path, re.Match[str]]:
    """Return the files of the log *who*, or of all logs if it is "", with the match of each file's name."""
    matches = {path: _FILE.fullmatch(path.name) for path in (folder.iterdir() if folder.is_dir() else ())}
    return {path: match for path, match in matches.items() if match and who in ("", match["who"])}
