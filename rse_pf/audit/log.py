"""Write an audit log to a folder, and read what is there.

One chain has one writer: ``WHO.jsonl``, whose older files are ``WHO.FIRST.jsonl``.  Promises that `record`
never waits for a disk, that what `flush` returned from is on it, that no entry is rewritten, and that a
chain goes on where a crash broke off, naming what was there.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rse_pf.audit.chain import (
    CONTINUED,
    GAP,
    GENESIS,
    Chain,
    Entry,
    Head,
    Note,
    Value,
    line_of,
    next_entry,
)
from rse_pf.errors import ConfigurationError
from rse_pf.files import sync_folder

__all__ = [
    "MAX_FILE_BYTES",
    "SYNC_S",
    "AuditLog",
    "audit_folder",
    "chain_names",
    "files_of",
    "lines_of",
    "newest_head",
    "record_once",
]

_FILE = re.compile(r"(?P<who>[A-Za-z0-9_-]{1,64})(\.(?P<first>\d{12}))?\.jsonl")
_UNSAFE = re.compile(r"[^A-Za-z0-9_-]")
_MAX_HELD = 20_000
_MAX_ENTRY_BYTES = 1 << 18
"""Longer than any entry: 64 details of two words of 200 letters, each letter six bytes at worst."""
_WAIT_S = 5.0
_LOOK_AGAIN_S = 0.01
MAX_FILE_BYTES = 16 << 20
"""A file that has grown longer is set aside, and the chain goes on in the next."""
SYNC_S = 0.1
"""An entry is on the disk after this."""


class AuditLog:
    """The one writer of the chain *who* in *folder*."""

    def __init__(
        self,
        folder: Path,
        who: str,
        *,
        wall_clock: Callable[[], float],
        max_bytes: int = MAX_FILE_BYTES,
        sync_s: float = SYNC_S,
        on_problem: Callable[[str], None] = lambda problem: None,
    ) -> None:
        """Describe a log; nothing is opened.

        Args:
            folder: Made if it is not there, with mode 0700.
            who: Names the writer; letters that a file name may not have become ``_``.
            wall_clock: Unix seconds.
            max_bytes: A file that has grown longer is set aside, and the chain goes on in the next.
            sync_s: How long an entry may wait for the disk.
            on_problem: Gets a sentence, once, when writing fails.
        """
        self.who = _UNSAFE.sub("_", who)[:64]
        self.head = GENESIS
        self.dropped = 0
        self._folder = folder
        self._wall_clock = wall_clock
        self._max_bytes = max_bytes
        self._sync_s = sync_s
        self.on_problem = on_problem
        self._failed = False
        self._held: list[Note] = []
        self._guard, self._writing = threading.Lock(), threading.Lock()
        self._wake, self._over = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._lock = self._fd = -1
        self._size = 0
        self._first = 1

    def open(self, wait_s: float = 0.0) -> AuditLog:
        """Take the log, and continue its chain.

        Raises:
            ConfigurationError: The folder cannot be used, or another process writes this log, also after
                *wait_s*.
        """
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            self._lock = os.open(self._folder / f".{self.who}.lock", os.O_RDWR | os.O_CREAT, 0o600)
            self._take_lock(wait_s)
            self._continue()
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
        """Hold an entry for the next flush; what does not fit into memory is counted.

        Args:
            action: What was done, as ``room.verb``.
            subject: To whom or to what.
            actor: Who did it; this writer, if empty.
            at_s: Unix seconds; now, if None.
            **detail: Names, numbers and reasons.
        """
        when = self._wall_clock() if at_s is None else at_s
        self.add([Note(time=when, actor=actor or self.who, action=action, subject=subject, detail=detail)])

    def add(self, notes: Iterable[Note]) -> None:
        """Hold several."""
        with self._guard:
            for note in notes:
                if len(self._held) >= _MAX_HELD:
                    self.dropped += 1
                else:
                    self._held.append(note)
        self._wake.set()

    def flush(self) -> None:
        """Write what is held and wait until it is on the disk; on failure it is held on."""
        with self._writing:
            with self._guard:
                notes, self._held = self._held, []
                dropped, self.dropped = self.dropped, 0
            if dropped:
                now = self._wall_clock()
                notes.append(Note(time=now, actor=self.who, action=GAP, detail={"entries": dropped}))
            if not notes or self._fd < 0:
                return
            try:
                self._write(notes)
                self._failed = False
            except OSError as error:
                with self._guard:
                    self._held = [note for note in notes if note.action != GAP] + self._held
                    self.dropped += dropped + max(0, len(self._held) - _MAX_HELD)
                    del self._held[_MAX_HELD:]
                if not self._failed:
                    self._failed = True
                    self.on_problem(f"the audit log of {self.who} cannot be written: {error.strerror}")

    def close(self) -> None:
        """Write what is held, and let go of the log."""
        self._over.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
        self.flush()
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
            time.sleep(_LOOK_AGAIN_S)  # a lock with a time limit: flock has none of its own

    def _continue(self) -> None:
        """Find the head, and set aside a file that a crash left in the middle of a line."""
        current = self._current
        older = [path for path in files_of(self._folder, self.who) if path != current]
        last = next((entry for path in reversed(older) if (entry := _last_entry(path)) is not None), None)
        if last is not None:
            self.head = last.head
        self._first = self.head.seq + 1
        reason = "interrupted" if older else ""
        if current.exists():
            found, is_whole = _last_entry(current), _ends_whole(current)
            if found is not None and is_whole:
                self.head, self._first, reason = found.head, _first_seq(current, found), ""
            elif found is not None:
                self.head, reason = found.head, "torn"
                self._set_aside(_first_seq(current, found))
            elif current.stat().st_size and _is_one_line(current):
                reason = "torn"
                current.replace(_free(self._folder / f"{self.who}.{self._first:012d}.torn"))
            elif current.stat().st_size:
                reason = "unreadable"  # it stays in the chain, so that nobody overlooks it
                self._set_aside(self._first)
        self._open_file()
        if reason:
            self._say_continued(reason)

    def _write(self, notes: list[Note]) -> None:
        head, lines = self.head, []
        for note in notes:
            entry = next_entry(head, note)
            head = entry.head
            lines.append(line_of(entry))
        data = b"".join(lines)
        try:
            view = memoryview(data)
            while view:
                view = view[os.write(self._fd, view) :]
            os.fsync(self._fd)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self._size)  # nobody was told that these are written
            raise
        self.head, self._size = head, self._size + len(data)
        if self._size > self._max_bytes:
            os.close(self._fd)
            self._set_aside(self._first)
            self._open_file()
            self._say_continued("rotated")

    def _say_continued(self, reason: str) -> None:
        self._first = self.head.seq + 1
        note = Note(
            time=self._wall_clock(), actor=self.who, action=CONTINUED,
            detail={"reason": reason, "head": str(self.head)},
        )  # fmt: skip
        entry = next_entry(self.head, note)
        os.write(self._fd, line_of(entry))
        os.fsync(self._fd)
        self.head, self._size = entry.head, self._size + len(line_of(entry))

    def _set_aside(self, first: int) -> None:
        while (place := self._folder / f"{self.who}.{first:012d}.jsonl").exists():
            first += 1  # only where a chain is broken already
        self._current.replace(place)

    def _open_file(self) -> None:
        self._fd = os.open(self._current, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        self._size = os.fstat(self._fd).st_size
        sync_folder(self._folder)

    def _release(self) -> None:
        for fd in (self._fd, self._lock):
            if fd >= 0:
                os.close(fd)
        self._fd = self._lock = -1

    @property
    def _current(self) -> Path:
        return self._folder / f"{self.who}.jsonl"

    def _write_on(self) -> None:
        while not self._over.is_set():
            self._wake.wait()
            self._over.wait(self._sync_s)
            self._wake.clear()
            self.flush()
            if self._failed:
                self._wake.set()  # try again, at the same pace


def record_once(
    folder: Path, who: str, action: str, subject: str = "", *, wall_clock: Callable[[], float],
    max_bytes: int = MAX_FILE_BYTES, **detail: Value,
) -> None:  # fmt: skip
    """Open the log, write one entry, and close it: for commands of an operator; raises ConfigurationError."""
    log = AuditLog(folder, who, wall_clock=wall_clock, max_bytes=max_bytes, sync_s=0.0).open(_WAIT_S)
    log.add([Note(time=wall_clock(), actor=who, action=action, subject=subject, detail=detail)])
    log.close()


def audit_folder(state: Path) -> Path:
    """Return where the platform whose files lie in *state* keeps its audit logs."""
    return state / "audit"


def chain_names(folder: Path) -> list[str]:
    """Return the names of all chains in *folder*."""
    matches = (_FILE.fullmatch(path.name) for path in folder.iterdir()) if folder.is_dir() else ()
    return sorted({match["who"] for match in matches if match})


def files_of(folder: Path, who: str) -> list[Path]:
    """Return the files of one chain, oldest first."""
    found = []
    for path in folder.iterdir() if folder.is_dir() else ():
        match = _FILE.fullmatch(path.name)
        if match and match["who"] == who:
            found.append((match["first"] or "~", path))
    return [path for _, path in sorted(found)]


def lines_of(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file with their newlines; the last one may have none, a huge one is cut."""
    with path.open("rb") as file:
        while line := file.readline(_MAX_ENTRY_BYTES):
            yield line


def newest_head(folder: Path, who: str) -> Head | None:
    """Return the head of a chain that may be written meanwhile; None if it has no entry."""
    for path in reversed(files_of(folder, who)):
        with contextlib.suppress(OSError):  # it was set aside this very moment
            entry = _last_entry(path)
            if entry is not None:
                return entry.head
    return None


def _last_entry(path: Path) -> Entry | None:
    """Return the last whole entry near the end of a file."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _MAX_ENTRY_BYTES))
        lines = file.read().split(b"\n")[:-1]
    entry = Chain(None).add(lines[-1] + b"\n") if lines else ""
    return entry if isinstance(entry, Entry) else None


def _first_seq(path: Path, last: Entry) -> int:
    first = Chain(None).add(next(lines_of(path)))
    return first.seq if isinstance(first, Entry) else last.seq


def _ends_whole(path: Path) -> bool:
    with path.open("rb") as file:
        if not file.seek(0, os.SEEK_END):
            return True
        file.seek(-1, os.SEEK_END)
        return file.read() == b"\n"


def _is_one_line(path: Path) -> bool:
    return not any(line.endswith(b"\n") for line in lines_of(path))


def _free(path: Path) -> Path:
    number = 0
    while path.exists():
        number += 1
        path = path.with_name(f"{path.name}-{number}")
    return path
