"""A lease: a record in a shared object store, which names the one process that holds the lease.

The record is changed by compare-and-swap only, so of two processes that claim the lease one succeeds.  The
holder renews it.  Another process measures with its own clock for how long the record has not changed, so
that the clocks of two machines are never compared.  The users of this module define the fields of the record,
and when another process may claim it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

import msgspec

from rse_pf.errors import Conflict, NotFound
from rse_pf.storage.object_store import ObjectStore

__all__ = ["Lease", "OwnedRecord", "read_record"]


def read_record(store: ObjectStore, name: str) -> bytes | None:
    """Return the bytes of the record *name* in *store*, None if there is none; raises StoreError."""
    try:
        return store.get(name)
    except NotFound:
        return None


class OwnedRecord(Protocol):
    """The fields that the record of every lease has."""

    @property
    def owner(self) -> str:
        """Name of the holder; each claim of each process uses another name."""

    @property
    def state(self) -> str:
        """What the holder does, or how its work ended."""

    @property
    def beat(self) -> int:
        """Number of renewals by the holder."""


R = TypeVar("R", bound=OwnedRecord)


class Lease(Generic[R]):
    """One process's copy of the record of a lease, and its writes to this record.

    The methods block, and must not be called by two threads at the same time.

    Attributes:
        name: Name of the record in the store.
        record: The record as this process read or wrote it last; None if there was none.
    """

    def __init__(
        self,
        store: ObjectStore,
        name: str,
        decode: Callable[[str, bytes], R],
        clock: Callable[[], float],
    ) -> None:
        """Create an empty copy; nothing is read yet.

        Args:
            store: The object store that all servers share.
            name: Name of the record.
            decode: Takes the name and the stored bytes of a record, and returns the record; raises StoreError
                if they are damaged.
            clock: Returns monotonic seconds.
        """
        self.name = name
        self.known: bytes | None = None
        """The bytes of the record as this process read or wrote it last; None if there was none."""
        self.record: R | None = None
        self._store = store
        self._decode = decode
        self._clock = clock
        self._changed_s = clock()
        self._written_s = float("-inf")
        self._reported_beat = -1

    @property
    def unchanged_s(self) -> float:
        """Seconds since this process last saw a change of the record, by a read, a write or `note_beat`.

        The value also grows while the record is not read.  Before the first change it is the time since this
        object was created.
        """
        return self._clock() - self._changed_s

    @property
    def age_s(self) -> float:
        """Seconds since the last successful write of this process began; infinite before the first one.

        At that time no other process had taken the lease.
        """
        return self._clock() - self._written_s

    def read(self) -> R | None:
        """Read the record from the store and return it, None if there is none; raises StoreError."""
        return self.note(read_record(self._store, self.name))

    def note(self, stored: bytes | None) -> R | None:
        """Note the bytes *stored* that were read from the store (None: no record), and return the record.

        A renewal that the holder has reported before, by `note_beat`, does not count as a change for
        `unchanged_s`.

        Raises:
            StoreError: The record is damaged.
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
        """Note that the holder has reported its renewal number *beat* directly, not through the store."""
        self._reported_beat = max(beat, self._reported_beat)
        self._changed_s = self._clock()

    def write(self, record: R) -> bool:
        """Replace the stored record by *record*, if it is still the one that this process read or wrote last.

        Returns whether *record* is stored.  If not, another process has changed the record, and ``record`` is
        its record.  If the store reports a conflict although it holds *record*, because the reply to an
        earlier attempt was lost, the write succeeded.

        Raises:
            StoreError: The store fails; whether *record* is stored is unknown.
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
