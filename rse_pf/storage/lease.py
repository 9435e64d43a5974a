"""A lease: one record in a shared store, of which one process at a time is the owner.

The record changes by compare-and-swap only, so of two processes that claim it one succeeds.  The
owner renews it; others watch it with their own clocks, so that the clocks of two machines are never compared.
Users of this module define the fields of the record, and when another process may claim it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import msgspec

from rse_pf.errors import Conflict, NotFound
from rse_pf.storage.object_store import ObjectStore

__all__ = ["Lease", "OwnedRecord", "read_record"]


def read_record(store: ObjectStore, name: str) -> bytes | None:
    """Return the record that is stored, None if there is none; raises StoreError."""
    try:
        return store.get(name)
    except NotFound:
        return None


class OwnedRecord(Protocol):
    """The fields that every record has: its owner, its state, and the number of its renewals."""

    @property
    def owner(self) -> str:
        """Name that is unique to a process and its claim."""

    @property
    def state(self) -> str:
        """What the owner does, or how it ended."""

    @property
    def beat(self) -> int:
        """Number of renewals."""


R = TypeVar("R", bound=OwnedRecord)


class Lease(Generic[R]):
    """What one process knows of one record, and its writes to it.  Blocking; for one thread at a time."""

    def __init__(
        self,
        store: ObjectStore,
        name: str,
        decode: Callable[[str, bytes], R],
        clock: Callable[[], float],
    ) -> None:
        """Read nothing yet.

        Args:
            store: Shared by all servers.
            name: Of the record.
            decode: Returns the record in bytes that were stored under a name; raises StoreError.
            clock: Seconds, monotonic.
        """
        self.name = name
        self.known: bytes | None = None
        """As the record was read or written last; None if there was none."""
        self.record: R | None = None
        self._store = store
        self._decode = decode
        self._clock = clock
        self._changed_s = clock()
        self._written_s = float("-inf")
        self._reported_beat = -1

    @property
    def unchanged_s(self) -> float:
        """Seconds since this process last noticed a change of the record, by a read, a write or `note_beat`.

        They also increase while the record is not read.  Before the first change they count from the creation
        of this object.
        """
        return self._clock() - self._changed_s

    @property
    def age_s(self) -> float:
        """Seconds since the begin of the last write that succeeded: nobody took the lease before that."""
        return self._clock() - self._written_s

    def read(self) -> R | None:
        """Read the record; raises StoreError."""
        return self.note(read_record(self._store, self.name))

    def note(self, stored: bytes | None) -> R | None:
        """Note what was read from the store.

        A renewal that the owner has reported by `note_beat` before is no change.
        """
        if stored == self.known:
            return self.record
        before = self.record
        now = None if stored is None else self._decode(self.name, stored)
        self.known, self.record = stored, now
        if before is None or now is None or (now.owner, now.state) != (before.owner, before.state):
            self._reported_beat = -1
        if now is None or now.beat > self._reported_beat:
            self._changed_s = self._clock()
        return now

    def note_beat(self, beat: int) -> None:
        """Note that the owner itself reported renewal number *beat*."""
        self._reported_beat = max(beat, self._reported_beat)
        self._changed_s = self._clock()

    def write(self, record: R) -> bool:
        """Replace the record that this process knows; return False if the store holds another one.

        In that case this process knows the other record afterwards.  A write whose reply was lost succeeded
        if the store holds its data.

        Raises:
            StoreError: The store fails; nothing is known.
        """
        began_s = self._clock()
        data = msgspec.json.encode(record)
        stored: bytes | None = data
        try:
            self._store.compare_and_swap(self.name, self.known, data)
        except Conflict:
            stored = read_record(self._store, self.name)
        self.note(stored)
        if stored != data:
            return False
        self._written_s = began_s
        return True
