"""A lease: one record in a shared store, of which one process at a time is the owner.

The record changes by compare-and-swap only, so of two processes that claim it one succeeds.  The
owner renews it; others watch it with their own clocks, so that the clocks of two machines are never compared.
What the record says, and when it may be claimed, is decided by those who use it.
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
    """What every record says: who owns it, in which state, and how often it was renewed."""

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
        self._heard = -1

    @property
    def unchanged_s(self) -> float:
        """For how long this process has known the record unchanged, in seconds."""
        return self._clock() - self._changed_s

    @property
    def age_s(self) -> float:
        """Seconds since the begin of the last write that succeeded: nobody took the lease before that."""
        return self._clock() - self._written_s

    def read(self) -> R | None:
        """Read the record; raises StoreError."""
        return self.note(read_record(self._store, self.name))

    def note(self, found: bytes | None) -> R | None:
        """Take what was read from the store; a renewal that the owner has told is no change."""
        if found == self.known:
            return self.record
        before = self.record
        now = None if found is None else self._decode(self.name, found)
        self.known, self.record = found, now
        if before is None or now is None or (now.owner, now.state) != (before.owner, before.state):
            self._heard = -1
        if now is None or now.beat > self._heard:
            self._changed_s = self._clock()
        return now

    def note_beat(self, beat: int) -> None:
        """Take that the owner itself told of renewal number *beat*."""
        self._heard = max(beat, self._heard)
        self._changed_s = self._clock()

    def write(self, record: R) -> bool:
        """Replace what this process knows; False if there is something else, which it then knows.

        A write whose answer was lost counts by what it left.

        Raises:
            StoreError: The store fails; nothing is known.
        """
        began_s = self._clock()
        data = msgspec.json.encode(record)
        found: bytes | None = data
        try:
            self._store.compare_and_swap(self.name, self.known, data)
        except Conflict:
            found = read_record(self._store, self.name)
        self.note(found)
        if found != data:
            return False
        self._written_s = began_s
        return True
