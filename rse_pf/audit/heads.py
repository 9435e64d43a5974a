"""The heads of all chains of a folder, in one file beside them: so that a cut end or a lost log is noticed.

A chain alone does not show that its last entries were removed, or that it was removed as a whole.  The file
``heads`` has a line of fixed length for each chain.  A writer finds or adds its line when it opens its log,
and overwrites only that line, after its entries are on the disk.  So no line is ahead of its chain, writers
do not wait for each other, and a crash leaves old heads, not wrong ones.  An attacker has to forge this
file, and the entries in which writers record each other's heads; see `rse_pf.audit.log`.

A line also says how many entries its writer lost when it ended on a full disk: it is overwritten in place,
which needs no space.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Callable, Mapping
from pathlib import Path

from rse_pf.audit.chain import GENESIS, Head, parse_head
from rse_pf.disk_reserve import preallocate
from rse_pf.files import replace_file

__all__ = ["FILE", "HeadsFile", "read_heads", "write_heads"]

FILE = "heads"
_LINE_BYTES = 256
"""A divisor of the size of a page, so that no line is written in two parts."""
_MAX_BYTES = 1 << 24
_AHEAD_BYTES = 64 << 10
"""Blocks are taken for so much after the end, so that a chain can begin on a full disk."""
_LOST = " lost="


class HeadsFile:
    """The line of one chain in the file of heads, while its log is open."""

    def __init__(self, folder: Path, who: str, present: Callable[[], Mapping[str, Head]]) -> None:
        """Describe it; nothing is opened.

        Args:
            folder: Of the logs.
            who: Name of the chain.
            present: Returns the heads of the chains that are there, for a file that has to be made.
        """
        self._path = folder / FILE
        self._who = who
        self._present = present
        self._fd = -1
        self._offset = 0
        self.lost_entries = 0
        """How many entries the writer before this one could not write at its end."""

    def open(self) -> tuple[Head, bool]:
        """Find or add the line of the chain; return its head, and whether the file was lost.

        A file is lost if it is missing or empty although there are entries.

        Raises:
            OSError: The file cannot be read or written.
        """
        self.close()
        self._fd = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._fd, fcntl.LOCK_EX)  # held for some microseconds, and only while a log is opened
        try:
            data = os.pread(self._fd, _MAX_BYTES, 0)
            with contextlib.suppress(OSError):  # the disk is full already, or cannot do it
                preallocate(self._fd, len(data) + _AHEAD_BYTES)
            was_lost = False
            if not data:
                heads = dict(self._present())
                was_lost = any(head.seq for head in heads.values())
                data = b"".join(_line(who, head) for who, head in heads.items())
                os.pwrite(self._fd, data, 0)
            for offset in range(0, len(data), _LINE_BYTES):
                line = _parse_line(data[offset : offset + _LINE_BYTES])
                if line is not None and line[0] == self._who:
                    self._offset = offset
                    self.lost_entries = line[2]
                    return line[1], was_lost
            self._offset = -(-len(data) // _LINE_BYTES) * _LINE_BYTES
            os.pwrite(self._fd, _line(self._who, GENESIS), self._offset)
            return GENESIS, was_lost
        finally:
            fcntl.flock(self._fd, fcntl.LOCK_UN)

    def is_lost(self) -> bool:
        """Whether the file was removed or emptied while it was open."""
        about = os.fstat(self._fd)
        return about.st_nlink == 0 or about.st_size <= self._offset

    def write(self, head: Head, lost_entries: int = 0) -> None:
        """Write *head*, which is that of the chain on the disk, and what was lost; raises OSError."""
        os.pwrite(self._fd, _line(self._who, head, lost_entries), self._offset)
        self.lost_entries = lost_entries

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1


def read_heads(folder: Path) -> tuple[dict[str, Head], list[str]] | None:
    """Return the heads in the file of *folder*, and what is wrong with it; None if there is no such file."""
    try:
        with (folder / FILE).open("rb") as file:
            data = file.read(_MAX_BYTES)
    except FileNotFoundError:
        return None
    heads: dict[str, Head] = {}
    problems = []
    for number in range(-(-len(data) // _LINE_BYTES)):
        line = _parse_line(data[number * _LINE_BYTES : (number + 1) * _LINE_BYTES])
        if line is None or line[0] in heads:
            problems.append(f"line {number + 1} was changed: it is not the head of a chain")
        else:
            heads[line[0]] = line[1]
    return heads, problems


def write_heads(folder: Path, heads: Mapping[str, Head]) -> None:
    """Write the file of heads for chains that were copied into *folder*."""
    replace_file(folder / FILE, b"".join(_line(who, heads[who]) for who in sorted(heads)), mode=0o600)


def _line(who: str, head: Head, lost_entries: int = 0) -> bytes:
    lost = f"{_LOST}{lost_entries}" if lost_entries else ""
    return f"{who} {head}{lost}".ljust(_LINE_BYTES - 1).encode() + b"\n"


def _parse_line(line: bytes) -> tuple[str, Head, int] | None:
    who, _, rest = line.decode("ascii", "replace").partition(" ")
    word, _, lost = rest.rstrip(" \n").partition(_LOST)
    head, count = parse_head(word), int(lost) if lost.isdigit() else 0
    return None if head is None or line != _line(who, head, count) else (who, head, count)
