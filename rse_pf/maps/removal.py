"""Remove versions of a map safely while other processes commit, roll back and read.

A mark beside the bytes of a version says that a process removes these bytes, or that a rollback needs them.
A removal first sets its mark, and then reads the records, the head and the marks of rollbacks.  A commit or a
rollback first writes its record or mark, and then looks for marks of removals.  So at least one of two
processes sees the other, as in Dekker's algorithm, and no head refers to removed bytes.

A mark is the empty object ``maps/TENANT/NAME/blobs/DIGEST.KIND-SECONDS-TOKEN``.  It is an empty file in an
existing folder, which can be written to a full disk.  A removal that is slow stops `MAX_REMOVAL_S` after it
has set its marks, long before they count as abandoned after `ABANDONED_S`; the next removal finishes the work
of a process that crashed.
"""

from __future__ import annotations

import contextlib
import re
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rse_pf.errors import Busy, StoreError
from rse_pf.maps.record import MapRecord
from rse_pf.storage.object_store import MIN_CHARGE_BYTES, ObjectStore, charge_of

__all__ = [
    "ABANDONED_S",
    "HELD",
    "MAX_REMOVAL_S",
    "REMOVING",
    "Mark",
    "Marks",
    "choose_superseded",
    "count_freed_bytes",
]

HELD = "held"  # kind of a mark by which a rollback protects the bytes of a version from removal
REMOVING = "removing"  # kind of a mark of a process that removes the bytes of a version
MAX_REMOVAL_S = 60.0
"""Seconds after the begin of a batch of removals at which the process deletes no more versions, and stops
with an error: long before other processes ignore its marks (`ABANDONED_S`)."""
ABANDONED_S = 600.0
"""Age in seconds above which a mark in the store is ignored: a process clears its marks soon after
`MAX_REMOVAL_S` at the latest, so that the process of an older mark has crashed."""
_RETRY_MS = 1000.0
"""Milliseconds after which a client should repeat a commit whose bytes are just being removed."""
_MARK = re.compile(rf"(?P<digest>[0-9a-f]{{64}})\.(?P<kind>{HELD}|{REMOVING})-(?P<set_s>\d+)-[0-9a-f]+")


@dataclass(frozen=True, slots=True)
class Mark:
    """A mark in the store.

    Attributes:
        name: Name of the object in the store.
        kind: `HELD` or `REMOVING`.
        digest: The sha256 of the marked bytes.
        set_s: When it was set, Unix seconds.
    """

    name: str
    kind: str
    digest: str
    set_s: float


class Marks:
    """The marks beside the bytes of one map.  Its methods block."""

    def __init__(self, store: ObjectStore, blobs: str, wall_clock: Callable[[], float]) -> None:
        """Make an object that reads and writes marks, and write none.

        Args:
            store: The store of the map.
            blobs: The folder of the bytes of the map's versions, with a slash at its end.
            wall_clock: Returns Unix seconds.
        """
        self._store, self._blobs, self._wall_clock = store, blobs, wall_clock

    def put(self, kind: str, digest: str) -> str:
        """Set a mark of this process on the bytes with a *digest*, and return the name of the mark."""
        name = f"{self._blobs}{digest}.{kind}-{int(self._wall_clock())}-{secrets.token_hex(8)}"
        self._store.put(name, b"")
        return name

    def clear(self, name: str) -> None:
        """Remove the mark with this *name*; if the store fails, it stays and is ignored after ten minutes."""
        with contextlib.suppress(StoreError):
            self._store.delete(name)

    def marked(self, kind: str, prefix: str = "") -> set[str]:
        """Return the digests with this *prefix* that have a mark of this *kind* which is not abandoned."""
        marks = self._list(prefix)
        return {mark.digest for mark in marks if mark.kind == kind and not self._is_abandoned(mark)}

    def check(self, digest: str) -> None:
        """Raise Busy if a process removes the bytes with this *digest*."""
        if self.marked(REMOVING, digest):
            raise Busy(
                "the same bytes are being removed from this map",
                hint="try again",
                retry_after_ms=_RETRY_MS,
            )

    def abandoned(self) -> list[Mark]:
        """Return the marks older than ten minutes: those of processes that crashed."""
        return [mark for mark in self._list("") if self._is_abandoned(mark)]

    def _is_abandoned(self, mark: Mark) -> bool:
        return self._wall_clock() - mark.set_s > ABANDONED_S

    def _list(self, prefix: str) -> list[Mark]:
        names = (info.name for info in self._store.list(self._blobs + prefix))
        matches = ((name, _MARK.fullmatch(name.removeprefix(self._blobs))) for name in names)
        return [
            Mark(name, match["kind"], match["digest"], float(match["set_s"]))
            for name, match in matches
            if match is not None
        ]


def choose_superseded(
    records: Sequence[MapRecord],
    head: str,
    *,
    keep: int,
    max_bytes: float = float("inf"),
    is_counted: Callable[[MapRecord], bool] = lambda record: True,
) -> list[MapRecord]:
    """Return the versions to remove so that only the newest ones stay, in the order from oldest to newest.

    A version that shares its bytes with a version that stays also stays, because removing it would free no
    bytes.

    Args:
        records: All versions of a map.
        head: Id of the head, which stays.
        keep: Number of the newest versions among those of *is_counted* that stay; the head may be one of
            them.
        max_bytes: Largest charge in bytes of these newest versions together, else fewer of them stay; the
            newest one stays in any case.
        is_counted: Returns whether a version may be removed and counts for *keep* and *max_bytes*; all other
            versions stay.
    """
    newest_first = sorted(
        records, key=lambda record: (record.created_s, record.number, record.id), reverse=True
    )
    count = total_bytes = 0
    kept_ids = {head}
    for record in newest_first:
        if not is_counted(record):
            kept_ids.add(record.id)
            continue
        count, total_bytes = count + 1, total_bytes + _charge_of(record)
        if count == 1 or (count <= keep and total_bytes <= max_bytes):
            kept_ids.add(record.id)
    kept_digests = {record.digest for record in records if record.id in kept_ids}
    return [
        record
        for record in reversed(newest_first)
        if record.id not in kept_ids and record.digest not in kept_digests
    ]


def count_freed_bytes(removed: Sequence[MapRecord]) -> int:
    """Return by how many bytes the charge of a tenant decreases when the versions *removed* are gone."""
    sizes = {record.digest: record.size for record in removed}  # Count bytes that versions share once.
    return sum(map(charge_of, sizes.values())) + len(removed) * MIN_CHARGE_BYTES


def _charge_of(record: MapRecord) -> int:
    """Return the bytes of the tenant's quota that a version takes: those of its map and of its record."""
    return charge_of(record.size) + MIN_CHARGE_BYTES
