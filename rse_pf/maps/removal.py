"""Remove versions of a map while others commit, roll back and read; nothing here knows a robot's right.

A mark beside the bytes of a version says that they are being removed, or that a rollback needs them.  Who
removes sets a mark first, and then looks at the versions, the head and the marks of rollbacks.  Who commits
or rolls back writes its record or mark first, and then looks for marks of removals.  So one of the two sees
the other, and no head refers to bytes that were removed.

A mark is an empty object ``maps/TENANT/NAME/blobs/DIGEST.KIND-SECONDS-TOKEN``: it needs no new folder, so
that a full disk takes it.  A process that removes stops long before its marks count as abandoned; the next
removal finishes what a crash has left.
"""

from __future__ import annotations

import contextlib
import re
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rse_pf.errors import Busy, StoreError
from rse_pf.maps.record import MapRecord
from rse_pf.object_store import MIN_CHARGE_BYTES, ObjectStore, charge_of

__all__ = ["ABANDONED_S", "HELD", "MOST_S", "REMOVING", "Mark", "Marks", "freed_bytes", "superseded"]

HELD, REMOVING = "held", "removing"
MOST_S, ABANDONED_S = 60.0, 600.0
"""A removal deletes nothing more after the first time; a mark of this age is ignored and cleaned away."""
_RETRY_MS = 1000.0
_MARK = re.compile(rf"(?P<digest>[0-9a-f]{{64}})\.(?P<kind>{HELD}|{REMOVING})-(?P<set_s>\d+)-[0-9a-f]+")


@dataclass(frozen=True, slots=True)
class Mark:
    """A mark that is set: its name in the store, its kind, the bytes that it is about, when it was set."""

    name: str
    kind: str
    digest: str
    set_s: float


class Marks:
    """The marks beside the bytes of one map.  Blocking."""

    def __init__(self, store: ObjectStore, blobs: str, wall_clock: Callable[[], float]) -> None:
        """Set no mark yet.

        Args:
            store: Where the map lies.
            blobs: The folder of the map's bytes, which ends with a slash.
            wall_clock: Unix seconds.
        """
        self._store, self._blobs, self._wall_clock = store, blobs, wall_clock

    def put(self, kind: str, digest: str) -> str:
        """Set a mark of this process, and return its name."""
        name = f"{self._blobs}{digest}.{kind}-{int(self._wall_clock())}-{secrets.token_hex(8)}"
        self._store.put(name, b"")
        return name

    def clear(self, name: str) -> None:
        """Remove a mark; one that the store keeps is ignored in ten minutes."""
        with contextlib.suppress(StoreError):
            self._store.delete(name)

    def marked(self, kind: str, beginning: str = "") -> set[str]:
        """Return the digests with this *beginning* that processes marked which may still be at work."""
        marks = self._list(beginning)
        return {mark.digest for mark in marks if mark.kind == kind and not self._is_abandoned(mark)}

    def check(self, digest: str) -> None:
        """Raise Busy if these bytes are being removed."""
        if self.marked(REMOVING, digest):
            raise Busy(
                "the same bytes are being removed from this map", hint="try again",
                retry_after_ms=_RETRY_MS,
            )  # fmt: skip

    def abandoned(self) -> list[Mark]:
        """Return the marks of processes that crashed."""
        return [mark for mark in self._list("") if self._is_abandoned(mark)]

    def _is_abandoned(self, mark: Mark) -> bool:
        return self._wall_clock() - mark.set_s > ABANDONED_S

    def _list(self, beginning: str) -> list[Mark]:
        listed = (info.name for info in self._store.list(self._blobs + beginning))
        matches = ((name, _MARK.fullmatch(name.removeprefix(self._blobs))) for name in listed)
        return [
            Mark(name, match["kind"], match["digest"], float(match["set_s"]))
            for name, match in matches
            if match is not None
        ]


def superseded(
    records: Sequence[MapRecord], head: str, *, keep: int, most_bytes: float = float("inf"),
    counts: Callable[[MapRecord], bool] = lambda record: True,
) -> list[MapRecord]:  # fmt: skip
    """Return the versions to remove so that the newest *keep* stay, oldest first.

    The head stays, and what shares its bytes with a version that stays: to remove it would free nothing.

    Args:
        records: All versions of a map.
        head: Id of the head.
        keep: How many of those that count stay, besides the head.
        most_bytes: What those that stay may count for together; the newest one stays in any case.
        counts: Which versions count; the others stay.
    """
    newest_first = sorted(records, key=lambda each: (each.created_s, each.number, each.id), reverse=True)
    counted = total = 0
    stay = {head}
    for record in newest_first:
        if not counts(record):
            stay.add(record.id)
            continue
        counted, total = counted + 1, total + _charge_of(record)
        if counted == 1 or (counted <= keep and total <= most_bytes):
            stay.add(record.id)
    digests = {record.digest for record in records if record.id in stay}
    return [each for each in reversed(newest_first) if each.id not in stay and each.digest not in digests]


def freed_bytes(removed: Sequence[MapRecord]) -> int:
    """Return how many bytes less a tenant is charged with without these versions."""
    sizes = {record.digest: record.size for record in removed}  # versions may share their bytes
    return sum(map(charge_of, sizes.values())) + len(removed) * MIN_CHARGE_BYTES


def _charge_of(record: MapRecord) -> int:
    """Return what a version counts for: its bytes, and its record."""
    return charge_of(record.size) + MIN_CHARGE_BYTES
