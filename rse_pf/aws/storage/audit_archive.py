"""The audit logs of a cloud: servers upload them in pieces while they write, and an operator fetches them.

The new entries of each chain become one object, a piece, ``audit/INSTANCE/WHO.FIRST.DIGEST.jsonl``: FIRST is
the number of its first entry, DIGEST the beginning of its sha256.  `Shipper` writes each name once, and reads
and deletes nothing in the bucket.  Entries that look wrong are uploaded, too.  After a crash pieces may
overlap, but no entry is missing.

`fetch_audit` only reads.  It joins the pieces to the files that `rse_pf.audit.verify` checks; every line is
kept, except repeated ones.  A chain is named after its instance: ``INSTANCE`` is the backend server's own,
``INSTANCE_WHO`` belongs to another writer on that instance.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

import msgspec

from rse_pf.audit.chain import GENESIS, Chain, Entry, Head, parse_head
from rse_pf.audit.heads import write_heads
from rse_pf.audit.log import chain_names, files_of, newest_head
from rse_pf.aws.account import Account
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.config.resource_names import AUDIT_PREFIX, ResourceNames
from rse_pf.errors import Conflict
from rse_pf.files import replace_json
from rse_pf.object_store import ObjectStore

__all__ = ["Shipper", "fetch_audit", "open_audit_archive", "piece_name"]

_DIGEST_LETTERS = 32
# Of one piece: it uploads in about a second, and the agent holds at most two of them in memory.
_MAX_BYTES = 1 << 23
_MAX_ATTEMPTS = 3
_PIECE = re.compile(
    rf"{AUDIT_PREFIX}/(?P<instance>[A-Za-z0-9_-]{{1,64}})/"
    rf"(?P<who>[A-Za-z0-9_-]{{1,64}})\.(?P<first>\d{{12}})\.(?P<digest>[0-9a-f]{{{_DIGEST_LETTERS}}})\.jsonl"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Mark:
    """How far a chain was uploaded: the file, the offset after the last byte, and the chain's head there."""

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
    """Uploads the chains in one folder."""

    def __init__(
        self,
        folder: Path,
        store: ObjectStore,
        *,
        marks_file: Path,
        instance: Callable[[], str],
        on_broken: Callable[[str, str], None],
    ) -> None:
        """Make a shipper; nothing is read.

        Args:
            folder: Where the logs are written.
            store: The bucket; the shipper only writes new names.
            marks_file: Where it keeps how far each chain was uploaded.
            instance: Returns the name of this machine.
            on_broken: Gets a chain and a problem when an entry does not follow the previous one.
        """
        self._folder = folder
        self._store = store
        self._marks_file = marks_file
        self._instance = instance
        self._on_broken = on_broken

    def ship(self) -> int:
        """Upload new entries; return the number of pieces.

        Raises:
            StoreError: The bucket refused a piece, which the next call uploads.
            OSError: A log cannot be read.
        """
        marks, count = self._marks(), 0
        for chain in chain_names(self._folder):
            for piece in _read_pieces(self._folder, chain, marks.get(chain, _Mark())):
                if piece.problem:
                    self._on_broken(chain, piece.problem)
                name = piece_name(self._instance(), chain, piece.first, piece.data)
                # Only the bytes of its digest take a name: they arrived before, and their mark was lost.
                with contextlib.suppress(Conflict):
                    self._store.compare_and_swap(name, None, piece.data)
                marks[chain] = piece.after
                replace_json(self._marks_file, {chain: asdict(mark) for chain, mark in marks.items()})
                count += 1
        return count

    def _marks(self) -> dict[str, _Mark]:
        """Return the marks; when they cannot be read, everything is uploaded again."""
        try:
            return msgspec.json.decode(self._marks_file.read_bytes(), type=dict[str, _Mark])
        except (FileNotFoundError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return {}


def piece_name(instance: str, chain: str, first: int, data: bytes) -> str:
    """Return the name of a piece, which holds the digest of its bytes."""
    digest = hashlib.sha256(data).hexdigest()[:_DIGEST_LETTERS]
    return f"{AUDIT_PREFIX}/{instance}/{chain}.{first:012d}.{digest}.jsonl"


def open_audit_archive(account: Account, names: ResourceNames) -> S3Store:
    """Return the bucket of a deployment's audit logs; raises ConfigurationError if there is none."""
    return S3Store(
        account.client("s3"), account.resource(names.stack("Data"), "AWS::S3::Bucket", "AuditLogs")
    )


def fetch_audit(store: ObjectStore, folder: Path) -> list[str]:
    """Write the logs in *store* as files into *folder*; return what is wrong with single pieces.

    Raises:
        StoreError: The bucket cannot be read.
    """
    problems: list[str] = []
    chains: dict[str, list[tuple[int, str]]] = {}
    for info in store.list(f"{AUDIT_PREFIX}/"):
        match = _PIECE.fullmatch(info.name)
        if match is None:
            problems.append(f"{info.name} is not a piece of an audit log")
            continue
        instance, writer = match["instance"], match["who"]
        chain = writer if writer == instance else f"{instance}_{writer}"[:64]
        chains.setdefault(chain, []).append((int(match["first"]), info.name))
    folder.mkdir(parents=True, exist_ok=True)
    for chain, pieces in sorted(chains.items()):
        seen: set[bytes] = set()
        for first, name in sorted(pieces):
            data = store.get(name)
            if hashlib.sha256(data).hexdigest()[:_DIGEST_LETTERS] != name.rsplit(".", 2)[1]:
                problems.append(f"{name} was changed: its bytes do not have the digest in its name")
            _write(folder, chain, first, list(_new_lines(data, seen)))
    if chains:
        write_heads(folder, {chain: newest_head(folder, chain) or GENESIS for chain in chains})
    return problems


def _read_pieces(folder: Path, chain: str, mark: _Mark) -> Iterator[_Piece]:
    """Yield what follows *mark*; a piece is part of one file, and only the newest file may still grow."""
    with contextlib.ExitStack() as stack:
        files = _open_files(folder, chain, stack)
        inodes = [os.fstat(file.fileno()).st_ino for file in files]
        if mark.inode in inodes and os.fstat(files[inodes.index(mark.inode)].fileno()).st_size < mark.offset:
            mark = _Mark()  # the file was truncated: the rest is uploaded again, and its head does not match
        begin = inodes.index(mark.inode) if mark.inode in inodes else 0
        if mark.inode not in inodes:
            mark = _Mark()
        head = parse_head(mark.head) or GENESIS
        for number in range(begin, len(files)):
            offset = mark.offset if inodes[number] == mark.inode else 0
            while data := _read_piece(files[number], offset, is_whole=number + 1 < len(files)):
                offset += len(data)
                first, head, problem = _check_piece(data, head)
                yield _Piece(first, data, _Mark(inode=inodes[number], offset=offset, head=str(head)), problem)


def _open_files(folder: Path, chain: str, stack: contextlib.ExitStack) -> list[BinaryIO]:
    """Return the files of a chain, oldest first; none if they were rotated during every attempt."""
    for _ in range(_MAX_ATTEMPTS):
        with contextlib.suppress(FileNotFoundError):  # it was rotated meanwhile
            files: list[BinaryIO] = [stack.enter_context(path.open("rb")) for path in files_of(folder, chain)]
            there = [path.stat().st_ino for path in files_of(folder, chain)]
            if there == [os.fstat(file.fileno()).st_ino for file in files]:
                return files
    return []


def _read_piece(file: BinaryIO, offset: int, *, is_whole: bool) -> bytes:
    """Return at most one piece of whole lines; the last line of a finished file may be incomplete."""
    data = os.pread(file.fileno(), _MAX_BYTES, offset)
    is_end = len(data) < _MAX_BYTES
    cut = data.rfind(b"\n") + 1
    return data if not cut and not is_end else data if is_whole and is_end else data[:cut]


def _check_piece(data: bytes, head: Head) -> tuple[int, Head, str]:
    """Return the first entry number in *data*, the head after it, and the first problem."""
    chain, first, problem = Chain(head), 0, ""
    for line in data.split(b"\n")[:-1]:  # an incomplete line is no entry; the next entry shows the gap
        entry = chain.add(line + b"\n")
        if isinstance(entry, str):
            problem = problem or entry
            entry = Chain(None).add(line + b"\n")
        if isinstance(entry, Entry):
            first = first or entry.seq
            chain.head = entry.head
    assert chain.head is not None
    return first or head.seq + 1, chain.head, problem


def _new_lines(data: bytes, digests: set[bytes]) -> Iterator[bytes]:
    """Yield the lines that no earlier piece had: an agent that lost its marks uploads some lines twice."""
    for line in re.findall(rb"[^\n]*\n|[^\n]+", data):
        digest = hashlib.sha256(line).digest()
        if digest not in digests:
            digests.add(digest)
            yield line


def _write(folder: Path, chain: str, first: int, lines: list[bytes]) -> None:
    if not lines:
        return
    entry = Chain(None).add(lines[0])
    number = entry.seq if isinstance(entry, Entry) else first
    while (path := folder / f"{chain}.{number:012d}.jsonl").exists():
        number += 1  # only where a chain is broken already
    path.write_bytes(b"".join(lines))
