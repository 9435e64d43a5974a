"""The files of the audit log: write one chain, and read any.

One chain has one writer.  It writes ``WHO.jsonl``; its older files are ``WHO.FIRST.jsonl``.  Recording never
waits for a disk; entries are durable when `AuditLog.flush` returns.  After a crash the chain continues
with an entry that says how its last file ended.

The head of each chain is kept twice more: in the file of heads, and in the chains of other writers.  The
control plane records the heads of all chains; each writer that runs records those of the control plane and of
operators.  A writer whose chain lacks the head in the file of heads records that head, and so names what was
removed.

A log has blocks of the disk for its next entries, and so goes on when the disk is full.  It then records
neither refusals nor, when little is left, connections; they are counted, and the gap is recorded once there
is space again.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rse_pf.audit.chain import (
    CONTINUED,
    GAP,
    GENESIS,
    HEADS,
    HEADS_LOST,
    Chain,
    Entry,
    Head,
    Note,
    Value,
    next_line,
)
from rse_pf.audit.heads import HeadsFile
from rse_pf.disk_reserve import allocated_bytes, is_full, preallocate
from rse_pf.errors import ConfigurationError
from rse_pf.files import sync_folder

__all__ = [
    "CONTROL_PLANE",
    "HEADS_S",
    "MAX_FILE_BYTES",
    "OPERATOR",
    "RESERVE_BYTES",
    "SYNC_S",
    "AuditBounds",
    "AuditLog",
    "audit_folder",
    "chain_names",
    "files_of",
    "grown_heads",
    "lines_of",
    "newest_head",
    "record_once",
    "release_reserves",
]

CONTROL_PLANE, OPERATOR = "control-plane", "operator"
"""The chains whose heads every writer that runs records."""
HEADS_S = 60.0
"""Time between two looks of a writer at the heads of other chains."""
_FILE = re.compile(r"(?P<who>[A-Za-z0-9_-]{1,64})(\.(?P<first>\d{12}))?\.jsonl")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")
_MAX_BUFFERED = 20_000
# Above the size of any entry: 64 details of two strings of 200 characters, six bytes each at worst.
_MAX_ENTRY_BYTES = 1 << 18
_LOCK_TIMEOUT_S = 5.0
_LOCK_POLL_S = 0.01
MAX_FILE_BYTES = 16 << 20
"""A file that has grown longer is set aside, and the chain goes on in the next."""
SYNC_S = 0.1
"""An entry is on the disk after this."""
RESERVE_BYTES = 256 << 10
"""A log takes blocks for so many bytes of further entries, some 600; it asks for more when half are used."""
_REFUSALS = ("auth.refused", "auth.renewal-refused")
_CONNECTIONS = ("auth.accepted", "auth.renewed", *_REFUSALS)

# How the current file of a chain ends.  Empty: it is missing or empty, because the writer stopped between
# two files.  Torn: the last line, or the only one, is incomplete.  Unreadable: the last complete line is no
# entry.
_Ending = Literal["empty", "complete", "torn", "torn-first-line", "unreadable"]
_REASONS = {"empty": "interrupted", "torn-first-line": "torn"}


@dataclass(frozen=True, slots=True, kw_only=True)
class AuditBounds:
    """How large an audit log may become, and how long it may wait.

    Attributes:
        max_bytes: A file that has grown longer is set aside, and the chain goes on in the next.
        sync_s: How long an entry may wait for the disk.
        max_buffered: How many entries may wait for the disk; further ones are dropped and counted.
        heads_s: How often a log that was started records the heads of the control plane and of operators.
    """

    max_bytes: int = MAX_FILE_BYTES
    sync_s: float = SYNC_S
    max_buffered: int = _MAX_BUFFERED
    heads_s: float = HEADS_S


_BOUNDS = AuditBounds()


class AuditLog:
    """The only writer of the chain *who* in *folder*."""

    def __init__(
        self,
        folder: Path,
        who: str,
        *,
        wall_clock: Callable[[], float],
        bounds: AuditBounds = _BOUNDS,
        on_problem: Callable[[str], None] = lambda problem: None,
    ) -> None:
        """Describe a log; nothing is opened yet.

        Args:
            folder: Created with mode 0700 if it is missing.
            who: Names the writer; letters that a file name may not have become ``_``.
            wall_clock: Unix seconds.
            bounds: Its sizes and times.
            on_problem: Called once with a sentence when writing fails.
        """
        self.who = _UNSAFE.sub("_", who)[:64]
        self.head = GENESIS
        self.dropped = 0
        self._folder = folder
        self._wall_clock = wall_clock
        self._bounds = bounds
        self._others = [] if self.who == CONTROL_PLANE else sorted({CONTROL_PLANE, OPERATOR} - {self.who})
        self._recorded: dict[str, str] = {}
        self._heads = HeadsFile(folder, self.who, lambda: _heads_in(folder))
        self.on_problem = on_problem
        self._failed = False
        self._buffered: list[Note] = []
        self._buffer_lock, self._writing = threading.Lock(), threading.Lock()
        self._wake, self._closed = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._lock = self._fd = -1
        self._size = 0
        self._first = 1
        self._reserved = 0  # up to where the file has blocks
        self._is_short = False

    def open(self, wait_s: float = 0.0) -> AuditLog:
        """Lock the log, and continue its chain.

        Raises:
            ConfigurationError: The folder cannot be used, or another process still writes this log after
                *wait_s*.
        """
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = os.open(self._folder / f".{self.who}.lock", os.O_RDWR | os.O_CREAT, 0o600)
            self._take_lock(wait_s)
            known, was_lost = self._heads.open()
            self._continue()
            if known.seq > self.head.seq or (known.seq and not _holds(self._folder, self.who, known)):
                self._write([self._own_note(HEADS, {self.who: str(known)})])
            if was_lost:
                self._write([self._own_note(HEADS_LOST)])
            self.dropped += self._heads.lost_entries
            self._keep_head()
            if self.who in (CONTROL_PLANE, OPERATOR):
                self._reserve()
        except OSError as error:
            self._release()
            raise ConfigurationError(
                f"cannot write the audit log in {self._folder}: {error.strerror}",
                hint="make the folder writable, or name another with --audit",
            ) from error
        return self

    def start(self) -> None:
        """Write by a thread of its own from now on, ``sync_s`` after the first of each batch."""
        self._thread = threading.Thread(target=self._write_on, name="audit", daemon=True)
        self._thread.start()

    def record(
        self, action: str, subject: str = "", *, actor: str = "", at_s: float | None = None, **detail: Value
    ) -> None:
        """Buffer an entry for the next flush; entries beyond the buffer's limit are dropped and counted.

        Args:
            action: What was done, such as ``robot.enrolled``.
            subject: The object of the action.
            actor: Who did it; empty for this writer.
            at_s: Unix seconds; now, if None.
            **detail: Names, numbers and reasons.
        """
        when = self._wall_clock() if at_s is None else at_s
        self.add([Note(time=when, actor=actor or self.who, action=action, subject=subject, detail=detail)])

    def add(self, notes: Iterable[Note]) -> None:
        """Buffer several entries."""
        with self._buffer_lock:
            for note in notes:
                if len(self._buffered) >= self._bounds.max_buffered:
                    self.dropped += 1
                else:
                    self._buffered.append(note)
        self._wake.set()

    def flush(self) -> None:
        """Write the buffered entries and wait until they are on the disk; on failure they stay buffered."""
        with self._writing:
            with self._buffer_lock:
                notes, self._buffered = self._buffered, []
            if self._fd < 0:
                return
            if self._is_short:
                self._reserve()
            if self._is_short:
                notes = self._without_routine(notes)
            else:
                notes += self._gap()
            if not notes:
                return
            try:
                while notes:  # one by one when space is short: a long batch leaves nothing for others
                    count = 1 if self._is_short else len(notes)
                    self._write(notes[:count])
                    del notes[:count]
                self._failed = False
            except OSError as error:
                self._keep_for_later(notes)
                if not self._failed:
                    self._failed = True
                    self.on_problem(f"the audit log of {self.who} cannot be written: {error.strerror}")
            try:
                self._keep_head()
            except OSError as error:
                self.on_problem(f"the head of the audit log of {self.who} cannot be kept: {error.strerror}")

    @property
    def waiting(self) -> int:
        """How many entries are buffered."""
        return len(self._buffered)

    def close(self) -> None:
        """Write the buffered entries, and unlock the log."""
        self._closed.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
            self._record_others()
        self.flush()
        if self._fd >= 0:
            with contextlib.suppress(OSError):  # where no line can be overwritten, nothing can be kept
                self._keep_head()
            if self.who not in (CONTROL_PLANE, OPERATOR):
                os.ftruncate(self._fd, self._size)  # this log may never go on: its reserve is given back
        self._release()

    # --- the disk --------------------------------------------------------------------------------

    def _take_lock(self, wait_s: float) -> None:
        end = time.monotonic() + wait_s
        while True:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError as error:
                if time.monotonic() >= end:
                    self._release()
                    raise ConfigurationError(
                        f"another process writes the audit log {self.who} in {self._folder}",
                        hint="give each server a name or a folder of its own",
                    ) from error
            time.sleep(_LOCK_POLL_S)  # flock has no time limit of its own

    def _continue(self) -> None:
        """Find the head of the chain, and rename a current file that cannot be continued."""
        current = self._current
        older = [path for path in files_of(self._folder, self.who) if path != current]
        last = next((entry for path in reversed(older) if (entry := _last_entry(path)) is not None), None)
        if last is not None:
            self.head = last.head
        self._first = self.head.seq + 1
        ending = _ending_of(current)
        newest = _last_entry(current) if ending in ("complete", "torn") else None
        if newest is not None:
            self.head, self._first = newest.head, _first_seq(current, newest)
        if ending in ("torn", "unreadable"):  # an unreadable file stays in the chain, to be noticed
            self._set_aside(self._first)
        elif ending == "torn-first-line":
            current.replace(_free_name(self._folder / f"{self.who}.{self._first:012d}.torn"))
        self._open_file()
        if ending != "complete" and (older or ending != "empty"):
            self._record_continued(_REASONS.get(ending, ending))

    def _write(self, notes: list[Note]) -> None:
        head, lines = self.head, []
        for note in notes:
            head, line = next_line(head, note)
            lines.append(line)
        data = b"".join(lines)
        if self._is_short and len(data) > self._reserved - self._size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # what is left stays for shorter ones
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(self._fd, view) :]
            os.fsync(self._fd)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._size)  # these entries were not reported as written
            self._reserved = self._size
            self._reserve()
            raise
        self.head, self._size = head, self._size + len(data)
        if 2 * (self._reserved - self._size) < RESERVE_BYTES:
            self._reserve()
        if self._size > self._bounds.max_bytes and not self._is_short:
            self._rotate()

    def _reserve(self) -> None:
        """Take blocks for the next entries."""
        try:
            preallocate(self._fd, self._size + RESERVE_BYTES)
            self._reserved, self._is_short = self._size + RESERVE_BYTES, False
        except OSError as error:  # a file system that cannot do it has no reserve, and is never short
            self._is_short = is_full(error)

    def _gap(self) -> list[Note]:
        with self._buffer_lock:
            dropped, self.dropped = self.dropped, 0
        return [self._own_note(GAP, {"entries": dropped})] if dropped else []

    def _without_routine(self, notes: list[Note]) -> list[Note]:
        """Drop what a flood of robots causes, and count it."""
        free_bytes = self._reserved - self._size
        routine = _CONNECTIONS if 4 * free_bytes < RESERVE_BYTES else _REFUSALS
        remaining = [note for note in notes if not note.action.startswith(routine)]
        with self._buffer_lock:
            self.dropped += len(notes) - len(remaining)
        return remaining

    def _keep_for_later(self, notes: list[Note]) -> None:
        """Buffer *notes* again, before newer ones; a gap is counted again."""
        with self._buffer_lock:
            gaps = [note for note in notes if note.action == GAP]
            self.dropped += sum(int(note.detail["entries"] or 0) for note in gaps)
            self._buffered = [note for note in notes if note not in gaps] + self._buffered
            self.dropped += max(0, len(self._buffered) - self._bounds.max_buffered)
            del self._buffered[self._bounds.max_buffered :]

    def _keep_head(self) -> None:
        """Write the head into the file of heads; one that was lost is made again, and that is recorded."""
        if self._heads.is_lost():
            self._heads.open()
            self._write([self._own_note(HEADS_LOST)])
        self._heads.write(self.head, self.dropped + (self.waiting if self._closed.is_set() else 0))

    def _record_others(self) -> None:
        grown = grown_heads(self._folder, self._others, self._recorded)
        if grown:
            self.add([self._own_note(HEADS, grown)])

    def _own_note(self, action: str, detail: Mapping[str, Value] | None = None) -> Note:
        return Note(time=self._wall_clock(), actor=self.who, action=action, detail=detail or {})

    def _record_continued(self, reason: str) -> None:
        self._first = self.head.seq + 1
        note = self._own_note(CONTINUED, {"reason": reason, "head": str(self.head)})
        self.head, line = next_line(self.head, note)
        os.write(self._fd, line)
        os.fsync(self._fd)
        self._size += len(line)

    def _rotate(self) -> None:
        """Go on in a new file; on failure the chain stays in the present one."""
        os.ftruncate(self._fd, self._size)
        place, old = self._set_aside(self._first), self._fd
        try:
            self._open_file()
        except OSError:
            place.replace(self._current)
            self._fd = old
            return
        os.close(old)
        self._reserve()
        with contextlib.suppress(OSError):  # the next entry goes on from the same head
            self._record_continued("rotated")

    def _set_aside(self, first: int) -> Path:
        while (place := self._folder / f"{self.who}.{first:012d}.jsonl").exists():
            first += 1  # only if the chain is broken already
        return self._current.replace(place)

    def _open_file(self) -> None:
        self._fd = os.open(self._current, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        self._size = os.fstat(self._fd).st_size
        self._reserved = max(self._size, allocated_bytes(self._fd))
        sync_folder(self._folder)

    def _release(self) -> None:
        for fd in (self._fd, self._lock):
            if fd >= 0:
                os.close(fd)
        self._fd = self._lock = -1
        self._heads.close()

    @property
    def _current(self) -> Path:
        return self._folder / f"{self.who}.jsonl"

    def _write_on(self) -> None:
        heads_due_s = time.monotonic() + self._bounds.heads_s
        while not self._closed.is_set():
            self._wake.wait(max(0.0, heads_due_s - time.monotonic()))
            if time.monotonic() >= heads_due_s:
                self._record_others()
                heads_due_s = time.monotonic() + self._bounds.heads_s
            self._closed.wait(self._bounds.sync_s)
            self._wake.clear()
            self.flush()
            if self._failed or self._is_short:
                self._wake.set()  # retry after the same interval


def record_once(
    folder: Path,
    who: str,
    action: str,
    subject: str = "",
    *,
    wall_clock: Callable[[], float],
    **detail: Value,
) -> None:
    """Open the log, write one entry and close it.

    Raises:
        ConfigurationError: The entry could not be written; if the disk was full, the next writer records a
            gap.
    """
    log = AuditLog(folder, who, wall_clock=wall_clock, bounds=AuditBounds(sync_s=0.0))
    log.open(_LOCK_TIMEOUT_S)
    log.add([Note(time=wall_clock(), actor=who, action=action, subject=subject, detail=detail)])
    log.close()
    if log.waiting:
        raise ConfigurationError(
            f"cannot write the audit log {who} in {folder}: the disk is full",
            hint="free some space; the log then records that an entry is missing",
        )


def release_reserves(folder: Path) -> list[str]:
    """Give back the blocks behind logs whose writers were killed, and return the names of these logs."""
    released = []
    for who in set(chain_names(folder)) - {CONTROL_PLANE, OPERATOR}:
        with contextlib.suppress(OSError), (folder / f"{who}.jsonl").open("r+b") as file:
            size = os.fstat(file.fileno()).st_size
            if allocated_bytes(file.fileno()) - size < RESERVE_BYTES // 4:
                continue
            with (folder / f".{who}.lock").open("r+b") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises while there is a writer
                file.truncate(os.fstat(file.fileno()).st_size)
                released.append(who)
    return sorted(released)


def audit_folder(state: Path) -> Path:
    """Return the folder of the audit logs of the platform with the state folder *state*."""
    return state / "audit"


def chain_names(folder: Path) -> list[str]:
    """Return the names of all chains in *folder*."""
    matches = (_FILE.fullmatch(path.name) for path in folder.iterdir()) if folder.is_dir() else ()
    return sorted({match["who"] for match in matches if match})


def files_of(folder: Path, who: str) -> list[Path]:
    """Return the files of one chain, oldest first."""
    paths = []
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _FILE.fullmatch(path.name)
        if match and match["who"] == who:
            paths.append((match["first"] or "~", path))
    return [path for _, path in sorted(paths)]


def lines_of(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file with their newlines; the last may lack it, an overlong one is split."""
    with path.open("rb") as file:
        while line := file.readline(_MAX_ENTRY_BYTES):
            yield line


def newest_head(folder: Path, who: str, *, apart_from: str = "") -> Head | None:
    """Return the head of a chain that may still be written; None if it has no entry.

    Args:
        folder: Of the logs.
        who: Name of the chain.
        apart_from: Entries of this action at the end of the chain are skipped.
    """
    for path in reversed(files_of(folder, who)):
        with contextlib.suppress(OSError):  # the file was renamed meanwhile
            entry = _last_entry(path, apart_from)
            if entry is not None:
                return entry.head
    return None


def grown_heads(folder: Path, names: Iterable[str], recorded: dict[str, str]) -> dict[str, Value]:
    """Return the heads of those chains that have grown, and update *recorded*, their heads as text.

    Entries that hold nothing but heads are not counted: two writers would answer each other forever.
    """
    grown: dict[str, Value] = {}
    for who in names:
        head = newest_head(folder, who, apart_from=HEADS)
        if head is not None and recorded.get(who) != str(head):
            grown[who] = recorded[who] = str(head)
    return grown


def _heads_in(folder: Path) -> dict[str, Head]:
    return {who: newest_head(folder, who) or GENESIS for who in chain_names(folder)}


def _holds(folder: Path, who: str, head: Head) -> bool:
    """Whether the chain has the entry *head*, which is near its end unless the writer was killed."""
    if newest_head(folder, who) == head:
        return True
    lines = (line for path in reversed(files_of(folder, who)) for line in lines_of(path))
    entries = (Chain(None).add(line) for line in lines)
    return any(isinstance(entry, Entry) and entry.head == head for entry in entries)


def _last_entry(path: Path, apart_from: str = "") -> Entry | None:
    """Return the last complete entry of a file, None if there is none near its end."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _MAX_ENTRY_BYTES))
        lines = file.read().split(b"\n")[:-1]
    for line in reversed(lines):
        entry = Chain(None).add(line + b"\n")
        if isinstance(entry, str):
            return None
        if entry.action != apart_from:
            return entry
    return None


def _first_seq(path: Path, last: Entry) -> int:
    first = Chain(None).add(next(lines_of(path)))
    return first.seq if isinstance(first, Entry) else last.seq


def _ending_of(path: Path) -> _Ending:
    if not path.exists() or not path.stat().st_size:
        return "empty"
    if _last_entry(path) is None:
        has_line = any(line.endswith(b"\n") for line in lines_of(path))
        return "unreadable" if has_line else "torn-first-line"
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return "complete" if file.read() == b"\n" else "torn"


def _free_name(path: Path) -> Path:
    number = 0
    while path.exists():
        number += 1
        path = path.with_name(f"{path.name}-{number}")
    return path
