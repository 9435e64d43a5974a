"""A lease: one record in a shared store, of which one process at a time is the owner.

The record changes by "put if the version is equal" only, so of two processes that claim it one succeeds.  The
owner renews it; others watch it with their own clocks, so that the clocks of two machines are never compared.
What the record says, and when it may be claimed, is decided by those who use it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import msgspec

from rse_pf.errors import Conflict, NotFound
from rse_pf.object_store import ObjectStore

__all__ = ["Lease", "ObjectRecords", "OwnedRecord", "Versioned"]


class Versioned(msgspec.Struct, frozen=True):
    """What a store holds under one name, and the version to which a change of it refers."""

    data: bytes
    version: bytes


class ObjectRecords:
    """The records of leases in an object store, where the bytes of an object are its version."""

    def __init__(self, store: ObjectStore) -> None:
        self._store = store

    def get(self, name: str) -> Versioned | None:
        """Return what is stored, None if there is nothing; raises StoreError."""
        try:
            data = self._store.get(name)
        except NotFound:
            return None
        return Versioned(data, data)

    def put(self, name: str, data: bytes, version: bytes | None) -> Versioned:
        """Replace what has *version*; raises Conflict and StoreError."""
        self._store.compare_and_swap(name, version, data)
        return Versioned(data, data)


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
        store: ObjectRecords,
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
        self.known: Versioned | None = None
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
        return self.note(self._store.get(self.name))

    def note(self, found: Versioned | None) -> R | None:
        """Take what was read from the store; a renewal that the owner has told is no change."""
        if found == self.known:
            return self.record
        before = self.record
        now = None if found is None else self._decode(self.name, found.data)
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
        version = None if self.known is None else self.known.version
        try:
            found: Versioned | None = self._store.put(self.name, data, version)
        except Conflict:
            found = self._store.get(self.name)
        self.note(found)
        if found is None or found.data != data:
            return False
        self._written_s = began_s
        return True
