"""The audit logs of a cloud: servers upload them in pieces while they write, and an operator fetches them.

The new lines of a log file become one object, a piece, ``audit/INSTANCE/WHO.TIME.DIGEST.jsonl``.  WHO is the
process that writes the log, TIME the time of the first entry in Unix seconds, DIGEST the beginning of the
piece's sha256.  `Shipper` writes each name once, and reads and deletes nothing in the bucket, where Object
Lock protects the pieces.  After a crash of the agent pieces may overlap, but no entry is missing.

`fetch_audit` only reads.  It joins the pieces of each writer to one file; of equal lines in several pieces it
keeps one.  The file of a backend server is named ``INSTANCE``, that of another writer on the same instance
``INSTANCE_WHO``.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import msgspec

from rse_pf.audit.entry import parse_entry
from rse_pf.audit.log import log_files, log_names
from rse_pf.aws.account import Account
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.config.resource_names import AUDIT_PREFIX, ResourceNames
from rse_pf.errors import Conflict
from rse_pf.storage.files import replace_json
from rse_pf.storage.object_store import ObjectStore

__all__ = ["Shipper", "fetch_audit", "open_audit_archive"]

_DIGEST_LETTERS = 32  # hexadecimal digits of a piece's sha256 in its name: 128 bits exclude collisions
_MAX_PIECE_BYTES = 1 << 23
"""Largest size of a piece: it uploads in about a second, and the agent holds one piece in memory."""
_PIECE = re.compile(
    rf"{AUDIT_PREFIX}/(?P<instance>[A-Za-z0-9_-]{{1,64}})/"
    rf"(?P<who>[A-Za-z0-9_-]{{1,64}})\.\d{{12}}\.[0-9a-f]{{{_DIGEST_LETTERS}}}\.jsonl"
)


class Shipper:
    """Uploads the audit logs in one folder to the audit bucket, in pieces."""

    def __init__(
        self, folder: Path, store: ObjectStore, *, marks_file: Path, instance: Callable[[], str]
    ) -> None:
        """Describe the shipper; nothing is read yet.

        Args:
            folder: Folder into which the servers write their logs.
            store: The audit bucket, in which only new names are written.
            marks_file: File in which the shipper keeps how many bytes of each log file were uploaded, by the
                file's inode.
            instance: Returns the instance id of this machine.
        """
        self._folder = folder
        self._store = store
        self._marks_file = marks_file
        self._instance = instance

    def ship(self) -> int:
        """Upload all entries that were not uploaded yet; return the number of pieces.

        Raises:
            StoreError: The bucket refused a piece; the next call uploads that piece again.
            OSError: A log cannot be read.
        """
        marks, count = self._marks(), 0
        for who in log_names(self._folder):
            for path in log_files(self._folder, who):
                # The file may have been renamed meanwhile; then the next call uploads its rest.
                with contextlib.suppress(FileNotFoundError):
                    count += self._ship_file(who, path, marks)
        return count

    def _ship_file(self, who: str, path: Path, marks: dict[str, int]) -> int:
        count = 0
        with path.open("rb") as file:
            about = os.fstat(file.fileno())
            inode = str(about.st_ino)
            if marks.get(inode, 0) > about.st_size:  # this is a new file with the inode of a removed file
                marks[inode] = 0
            while data := _read_lines(file, marks.get(inode, 0)):
                # A name that exists has the same bytes: they were uploaded before, without saving the mark.
                with contextlib.suppress(Conflict):
                    self._store.compare_and_swap(_piece_name(self._instance(), who, data), None, data)
                marks[inode] = marks.get(inode, 0) + len(data)
                replace_json(self._marks_file, marks)
                count += 1
        return count

    def _marks(self) -> dict[str, int]:
        """Return the number of uploaded bytes of each file, by inode.

        If the marks file is missing or cannot be read, return none, so that all logs are uploaded again.
        """
        try:
            return msgspec.json.decode(self._marks_file.read_bytes(), type=dict[str, int])
        except (FileNotFoundError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return {}


def open_audit_archive(account: Account, names: ResourceNames) -> S3Store:
    """Return the bucket of a deployment's audit logs; raises ConfigurationError if there is none."""
    return S3Store(
        account.client("s3"), account.resource(names.stack("Data"), "AWS::S3::Bucket", "AuditLogs")
    )


def fetch_audit(store: ObjectStore, folder: Path) -> None:
    """Write the audit logs in *store* into *folder*, one file for each writer; raises StoreError."""
    pieces: dict[str, list[str]] = {}
    for info in store.list(f"{AUDIT_PREFIX}/"):
        match = _PIECE.fullmatch(info.name)
        if match is not None:
            instance, writer = match["instance"], match["who"]
            who = writer if writer == instance else f"{instance}_{writer}"[:64]
            pieces.setdefault(who, []).append(info.name)
    folder.mkdir(parents=True, exist_ok=True)
    for who, names in pieces.items():
        known: set[bytes] = set()  # digests of lines: an agent without its marks uploads lines again
        with (folder / f"{who}.jsonl").open("wb") as file:
            for name in sorted(names):
                lines = store.get(name).splitlines(keepends=True)
                file.writelines(line for line in lines if hashlib.sha256(line).digest() not in known)
                known.update(hashlib.sha256(line).digest() for line in lines)


def _piece_name(instance: str, who: str, data: bytes) -> str:
    first = parse_entry(data[: data.index(b"\n")])
    time_s = 0 if first is None else int(first.time)
    digest = hashlib.sha256(data).hexdigest()[:_DIGEST_LETTERS]
    return f"{AUDIT_PREFIX}/{instance}/{who}.{time_s:012d}.{digest}.jsonl"


def _read_lines(file: BinaryIO, offset: int) -> bytes:
    """Return the whole lines of *file* from *offset* on, at most `_MAX_PIECE_BYTES`."""
    data = os.pread(file.fileno(), _MAX_PIECE_BYTES, offset)
    return data[: data.rfind(b"\n") + 1]
