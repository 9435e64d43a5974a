"""Fetch the audit logs of a cloud: pieces in a bucket become the files that `rse_pf.audit.verify` checks.

A chain is named after its instance: ``INSTANCE`` is the backend server's own, ``INSTANCE_WHO`` belongs to
another writer on that instance.  The bucket is only read; every line is kept, except repeated ones.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path

from rse_pf.audit.chain import Chain, Entry
from rse_pf.aws.account import Account
from rse_pf.aws.storage.audit_ship import DIGEST_LETTERS
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.config.resource_names import AUDIT_PREFIX, DATA_STACK
from rse_pf.object_store import ObjectStore

__all__ = ["fetch_audit", "open_audit_archive"]

_PIECE = re.compile(
    rf"{AUDIT_PREFIX}/(?P<instance>[A-Za-z0-9_-]{{1,64}})/"
    rf"(?P<who>[A-Za-z0-9_-]{{1,64}})\.(?P<first>\d{{12}})\.(?P<digest>[0-9a-f]{{{DIGEST_LETTERS}}})\.jsonl"
)


def open_audit_archive(account: Account) -> S3Store:
    """Return the bucket of the audit logs in *account*; raises ConfigurationError if there is none."""
    return S3Store(account.client("s3"), account.resource(DATA_STACK, "AWS::S3::Bucket", "AuditLogs"))


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
        instance, who = match["instance"], match["who"]
        chain = who if who == instance else f"{instance}_{who}"[:64]
        chains.setdefault(chain, []).append((int(match["first"]), info.name))
    folder.mkdir(parents=True, exist_ok=True)
    for chain, pieces in sorted(chains.items()):
        seen: set[bytes] = set()
        for first, name in sorted(pieces):
            data = store.get(name)
            if hashlib.sha256(data).hexdigest()[:DIGEST_LETTERS] != name.rsplit(".", 2)[1]:
                problems.append(f"{name} was changed: its bytes do not have the digest in its name")
            _write(folder, chain, first, list(_unseen(data, seen)))
    return problems


def _unseen(data: bytes, seen: set[bytes]) -> Iterator[bytes]:
    """Yield the lines that no earlier piece had: an agent that lost its marks uploads some lines twice."""
    for line in re.findall(rb"[^\n]*\n|[^\n]+", data):
        digest = hashlib.sha256(line).digest()
        if digest not in seen:
            seen.add(digest)
            yield line


def _write(folder: Path, chain: str, first: int, lines: list[bytes]) -> None:
    if not lines:
        return
    entry = Chain(None).add(lines[0])
    number = entry.seq if isinstance(entry, Entry) else first
    while (path := folder / f"{chain}.{number:012d}.jsonl").exists():
        number += 1  # only where a chain is broken already
    path.write_bytes(b"".join(lines))
