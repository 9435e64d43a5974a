"""Carry a server's audit log to a bucket while it is written, for a log must outlive its machine.

What is new in each chain goes as a piece of its own, ``audit/INSTANCE/WHO.FIRST.DIGEST.jsonl``: FIRST is the
number of its first entry, DIGEST the beginning of its sha256.  Promises to write each name once and to read
and delete nothing there, to hold back no entry that looks wrong, and that after any crash pieces may overlap
but never lack an entry; `rse_pf.aws.storage.audit_archive` puts them together again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

from rse_pf.audit.chain import GENESIS, Chain, Entry, Head, head_word
from rse_pf.audit.log import files_of, names_in
from rse_pf.config.resource_names import AUDIT_PREFIX
from rse_pf.errors import Conflict
from rse_pf.object_store import ObjectStore

__all__ = ["DIGEST_LETTERS", "Shipper", "piece_name"]

DIGEST_LETTERS = 32
_MAX_BYTES = 1 << 23
"""Of a piece: uploaded in a second, and two of them fit into the memory that an agent may take."""
_LOOKS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class _Mark:
    """How far a chain was carried: the file, the byte behind the last one, and the head there."""

    inode: int = 0
    offset: int = 0
    head: str = str(GENESIS)


@dataclass(frozen=True, slots=True)
class _Piece:
    first: int
    data: bytes
    after: _Mark
    problem: str


class Shipper:
    """Carries the chains in one folder."""

    def __init__(
        self,
        folder: Path,
        store: ObjectStore,
        *,
        marks_file: Path,
        instance: Callable[[], str],
        on_broken: Callable[[str, str], None],
    ) -> None:
        """Describe a shipper; nothing is read.

        Args:
            folder: Where the logs are written.
            store: The bucket; only writes of new names are asked of it.
            marks_file: Remembers how far each chain was carried.
            instance: Tells the name of this machine.
            on_broken: Gets a chain and a sentence, when an entry does not follow the one before.
        """
        self._folder = folder
        self._store = store
        self._marks_file = marks_file
        self._instance = instance
        self._on_broken = on_broken

    def ship(self) -> int:
        """Carry what is new; return the number of pieces.

        Raises:
            StoreError: The bucket did not take a piece: it is carried at the next call.
            OSError: A log cannot be read.
        """
        marks, count = self._marks(), 0
        for who in names_in(self._folder):
            for piece in _pieces(self._folder, who, marks.get(who, _Mark())):
                if piece.problem:
                    self._on_broken(who, piece.problem)
                name = piece_name(self._instance(), who, piece.first, piece.data)
                with contextlib.suppress(Conflict):  # the same bytes arrived, but their mark was lost
                    self._store.compare_and_swap(name, None, piece.data)
                marks[who] = piece.after
                self._remember(marks)
                count += 1
        return count

    def _marks(self) -> dict[str, _Mark]:
        """Return the marks; where they cannot be read everything is carried once more."""
        try:
            rows = json.loads(self._marks_file.read_text(encoding="utf-8"))
            return {str(who): _Mark(**row) for who, row in rows.items()}
        except (FileNotFoundError, ValueError, TypeError, AttributeError):
            return {}

    def _remember(self, marks: dict[str, _Mark]) -> None:
        temporary = self._marks_file.with_name(f".{self._marks_file.name}.new")
        temporary.write_text(json.dumps({who: asdict(mark) for who, mark in marks.items()}))
        os.replace(temporary, self._marks_file)


def piece_name(instance: str, who: str, first: int, data: bytes) -> str:
    """Return the name of a piece: whoever changes the bytes belies the name."""
    digest = hashlib.sha256(data).hexdigest()[:DIGEST_LETTERS]
    return f"{AUDIT_PREFIX}/{instance}/{who}.{first:012d}.{digest}.jsonl"


def _pieces(folder: Path, who: str, mark: _Mark) -> Iterator[_Piece]:
    """Yield what lies behind *mark*; no piece spans two files, only the newest file may still grow."""
    with contextlib.ExitStack() as stack:
        files = _opened(folder, who, stack)
        inodes = [os.fstat(file.fileno()).st_ino for file in files]
        if mark.inode in inodes and os.fstat(files[inodes.index(mark.inode)].fileno()).st_size < mark.offset:
            mark = _Mark()  # it was cut: what is left is carried again, and its head does not fit
        begin = inodes.index(mark.inode) if mark.inode in inodes else 0
        if mark.inode not in inodes:
            mark = _Mark()
        head = head_word(mark.head) or GENESIS
        for number in range(begin, len(files)):
            offset = mark.offset if inodes[number] == mark.inode else 0
            while data := _next(files[number], offset, is_whole=number + 1 < len(files)):
                offset += len(data)
                first, head, problem = _read(data, head)
                yield _Piece(first, data, _Mark(inode=inodes[number], offset=offset, head=str(head)), problem)


def _opened(folder: Path, who: str, stack: contextlib.ExitStack) -> list[BinaryIO]:
    """Return the files of a chain, oldest first; nothing if they are being moved all the time."""
    for _ in range(_LOOKS):
        with contextlib.suppress(FileNotFoundError):  # it was set aside this very moment
            files: list[BinaryIO] = [stack.enter_context(path.open("rb")) for path in files_of(folder, who)]
            there = [path.stat().st_ino for path in files_of(folder, who)]
            if there == [os.fstat(file.fileno()).st_ino for file in files]:
                return files
    return []


def _next(file: BinaryIO, offset: int, *, is_whole: bool) -> bytes:
    """Return at most a piece; up to a whole line, unless the file is over and ends within one."""
    data = os.pread(file.fileno(), _MAX_BYTES, offset)
    is_end = len(data) < _MAX_BYTES
    cut = data.rfind(b"\n") + 1
    return data if not cut and not is_end else data if is_whole and is_end else data[:cut]


def _read(data: bytes, head: Head) -> tuple[int, Head, str]:
    """Return the first number in *data*, the head behind it, and the first thing that is wrong."""
    chain, first, problem = Chain(head), 0, ""
    for line in data.split(b"\n")[:-1]:  # what a crash tore off is no entry, and the next one says so
        found = chain.add(line + b"\n")
        if isinstance(found, str):
            problem = problem or found
            found = Chain(None).add(line + b"\n")
        if isinstance(found, Entry):
            first = first or found.seq
            chain.head = found.head
    assert chain.head is not None
    return first or head.seq + 1, chain.head, problem
