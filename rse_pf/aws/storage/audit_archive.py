"""The audit logs of a cloud: servers upload them in pieces while they write, and an operator fetches them.

The new lines of a file become one object, a piece, ``audit/INSTANCE/WHO.TIME.DIGEST.jsonl``: TIME is that of
its first entry in Unix seconds, DIGEST the beginning of its sha256.  `Shipper` writes each name once, and
reads and deletes nothing in the bucket, where Object Lock keeps what was written.  After a crash of the
agent pieces may overlap, but no entry is missing.

`fetch_audit` only reads.  It joins the pieces of each writer to one file; of equal lines in several
pieces it keeps one.  A log is named after its instance: ``INSTANCE`` is the backend server's own,
``INSTANCE_WHO`` belongs to another writer on that instance.
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

_DIGEST_LETTERS = 32
_MAX_BYTES = 1 << 23
"""Of one piece: it uploads in about a second, and the agent holds one of them in memory."""
_PIECE = re.compile(
    rf"{AUDIT_PREFIX}/(?P<instance>[A-Za-z0-9_-]{{1,64}})/"
    rf"(?P<who>[A-Za-z0-9_-]{{1,64}})\.\d{{12}}\.[0-9a-f]{{{_DIGEST_LETTERS}}}\.jsonl"
)


class Shipper:
    """Uploads the logs in one folder."""

    def __init__(
        self, folder: Path, store: ObjectStore, *, marks_file: Path, instance: Callable[[], str]
    ) -> None:
        """Make a shipper; nothing is read.

        Args:
            folder: Where the logs are written.
            store: The bucket; the shipper only writes new names.
            marks_file: Where it keeps how many bytes of each file, by its inode, were uploaded.
            instance: Returns the name of this machine.
        """
        self._folder = folder
        self._store = store
        self._marks_file = marks_file
        self._instance = instance

    def ship(self) -> int:
        """Upload new entries; return the number of pieces.

        Raises:
            StoreError: The bucket refused a piece, which the next call uploads.
            OSError: A log cannot be read.
        """
        marks, count = self._marks(), 0
        for who in log_names(self._folder):
            for path in log_files(self._folder, who):
                with contextlib.suppress(FileNotFoundError):  # it was renamed; the next call uploads the rest
                    count += self._ship_file(who, path, marks)
        return count

    def _ship_file(self, who: str, path: Path, marks: dict[str, int]) -> int:
        count = 0
        with path.open("rb") as file:
            about = os.fstat(file.fileno())
            inode = str(about.st_ino)
            if marks.get(inode, 0) > about.st_size:  # another file that got the inode of a removed one
                marks[inode] = 0
            while data := _read_lines(file, marks.get(inode, 0)):
                # Only the same bytes take a name: they arrived before, and their mark was not written.
                with contextlib.suppress(Conflict):
                    self._store.compare_and_swap(_piece_name(self._instance(), who, data), None, data)
                marks[inode] = marks.get(inode, 0) + len(data)
                replace_json(self._marks_file, marks)
                count += 1
        return count

    def _marks(self) -> dict[str, int]:
        """Return the marks; when they cannot be read, everything is uploaded again."""
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
    """Write the logs in *store* as files into the new *folder*; raises StoreError."""
    pieces: dict[str, list[str]] = {}
    for info in store.list(f"{AUDIT_PREFIX}/"):
        match = _PIECE.fullmatch(info.name)
        if match is not None:
            instance, writer = match["instance"], match["who"]
            who = writer if writer == instance else f"{instance}_{writer}"[:64]
            pieces.setdefault(who, []).append(info.name)
    folder.mkdir(parents=True, exist_ok=True)
    for who, names in pieces.items():
        known: set[bytes] = set()  # an agent that lost its marks uploads lines again, in other pieces
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
    """Return at most one piece of whole lines from *offset* on."""
    data = os.pread(file.fileno(), _MAX_BYTES, offset)
    return data[: data.rfind(b"\n") + 1]
