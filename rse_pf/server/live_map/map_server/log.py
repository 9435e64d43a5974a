"""Store the log of a live map: numbered entries that are written once, and snapshots that shorten a restart.

Object names below ``live/TENANT/MAP/``:

- ``log/NUMBER``: an entry with one or more events, numbered from 1 without gaps.  It is created by
  compare-and-swap and never changed, so two map servers cannot write the same number: the one that finds its
  number taken has lost the map.
- ``snapshot/NUMBER``: the state of the map after that entry.  The two newest are kept; entries up to the
  number of the older one are deleted.
- ``features/EPOCH-SHA256``: parts of snapshots, with the epoch of the map server that wrote them.  Snapshots
  share unchanged parts.  A map server deletes no part of a later epoch: it may have lost the map without
  knowing, and its successor may not have written the snapshot yet that uses the part.

`LogWriter` collects events that arrive during a write into the next entry (group commit).
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass, field

import msgspec

from rse_pf.errors import Busy, Conflict, NotFound, RsePfError, StoreError, StoreFull
from rse_pf.live_map.events import Event, KeyframeAdded, encode_events
from rse_pf.live_map.outcomes import Outcome
from rse_pf.server.live_map.map_server.environment import (
    FIRST_RETRY_S,
    MapServerEnvironment,
    next_retry_s,
)
from rse_pf.storage.object_store import ObjectStore, digest_of

__all__ = [
    "BUSY_RETRY_MS",
    "SLOW_STORE_S",
    "LeaseLost",
    "LiveLog",
    "LogEntry",
    "LogWriter",
    "MapSnapshot",
    "SubmittedEvent",
    "entries_between_snapshots",
]

_MIN_ENTRIES_BETWEEN_SNAPSHOTS = 40
"""Number of log entries between two snapshots of a small map, the smallest such number; a restart applies
them again in less than 0.2 s."""
_MAX_ENTRIES_BETWEEN_SNAPSHOTS = 200
"""Number of log entries between two snapshots of a large map, the largest such number; a restart applies them
again in less than 0.8 s."""
_ENTRIES_PER_KEYFRAME = 0.25
"""Log entries between two snapshots for each keyframe in the map, within the two limits above: a snapshot of
a larger map costs more, so snapshots are written less often."""
_SNAPSHOTS_KEPT = 2
"""Number of snapshots of a map that are kept: if the newest is damaged, a restart uses the one before."""
_MAX_ENTRY_EVENTS = 64
"""Largest number of events in one log entry, which bounds the time for which the thread of the map applies
the entry; further events are written with the next entry."""
_MAX_ENTRY_BYTES = 4 << 20
"""Largest total size in bytes of the keyframes that share one log entry; it bounds the time of a write.  A
larger keyframe has an entry of its own."""
_MAX_QUEUED_EVENTS = 1024
"""Number of waiting events from which on keyframes are refused with Busy while the object store is slow;
other events are small and few, and are queued in any case."""
SLOW_STORE_S = 1.0
"""Seconds after which a write to the object store counts as slow, and subscribers are sent the state "waiting
for the store"."""
BUSY_RETRY_MS = 200.0
"""Milliseconds after which a robot sends a request again that a live map refused as busy."""


class LeaseLost(Conflict):
    """Another process serves the live map: it wrote the log entry or the lease that this one tried to write.

    Cause: The map server was paused or cut off from the store for longer than live.lease_s.
    Check: rse-pf map live list: which server serves the map now.
    Fix: Nothing; robots are served by the new map server.
    """


class LogEntry(msgspec.Struct, frozen=True, array_like=True):
    """One entry of the log, as stored in MessagePack.

    Attributes:
        epoch: Epoch of the lease under which the entry was written.
        owner: Name of the map server's process that wrote it.
        events: Events, encoded by `encode_events`.
    """

    epoch: int
    owner: str
    events: bytes


class _StoredSnapshot(msgspec.Struct, frozen=True, array_like=True):
    """A snapshot as stored in MessagePack in the object ``snapshot/NUMBER``; the parts are other objects."""

    digest: str  # SHA-256 of the head, by which a damaged snapshot is recognised
    unmeasured: tuple[int, ...]  # ids of keyframes without an event LoopClosuresMeasured in the log
    head: bytes  # encoded state of the map without the parts
    parts: dict[str, str] = {}  # names of the objects below features/, keyed by the name of the part


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSnapshot:
    """The state of a live map after one entry of its log.

    Attributes:
        position: Number of the entry.
        unmeasured: Ids of keyframes in the map without an event `LoopClosuresMeasured` in the log.  A
            keyframe that was measured without finding a loop closure has such an event.
        head: Encoded state of the map without the parts.
        parts: Content of the parts that *head* needs, by name; None for a part that is stored already.
    """

    position: int
    unmeasured: tuple[int, ...]
    head: bytes
    parts: Mapping[str, bytes | None] = field(default_factory=dict)


_encode = msgspec.msgpack.Encoder().encode
_decode_entry = msgspec.msgpack.Decoder(LogEntry).decode
_decode_snapshot = msgspec.msgpack.Decoder(_StoredSnapshot).decode


def entries_between_snapshots(keyframes: int) -> int:
    """Return how many log entries after the last snapshot of a map with *keyframes* the next one is written.

    The number balances the time of a restart, which applies each entry again in 2 to 4 ms, against the cost
    of a snapshot, which grows with the map: a quarter of the keyframes, at least 40, at most 200.
    """
    entries = max(_MIN_ENTRIES_BETWEEN_SNAPSHOTS, _ENTRIES_PER_KEYFRAME * keyframes)
    return round(min(_MAX_ENTRIES_BETWEEN_SNAPSHOTS, entries))


class LiveLog:
    """The stored entries and snapshots of one live map.

    All methods block on the object store.  One thread may read and write entries while another one writes
    snapshots.
    """

    def __init__(
        self,
        store: ObjectStore,
        folder: str,
        *,
        owner: str,
        epoch: int,
        base: int = 0,
        keeps_all: bool = False,
    ) -> None:
        """Describe the log; nothing is read yet.

        Args:
            store: Object store that all servers share.
            folder: Result of `map_folder` for the map.
            owner: Name of the process that writes entries.
            epoch: Epoch of the lease under which entries are written.
            base: Position at which the map was stopped last; entries up to it do not belong to the map.
            keeps_all: Whether no entry is deleted when a snapshot is written (``live.keep_log``).
        """
        self.position = base
        """Number of the entry that was read or written last."""
        self.stored_parts: dict[str, str] = {}
        """The parts of the snapshot that this object read or wrote last: names of their objects below
        ``features/``, keyed by the name of the part."""
        self._store = store
        self._entry_prefix = f"{folder}log/"
        self._snapshot_prefix = f"{folder}snapshot/"
        self._part_prefix = f"{folder}features/"
        self._owner = owner
        self._epoch = epoch
        self._base = base
        self._keeps_all = keeps_all

    def read_snapshots(self) -> Iterator[MapSnapshot]:
        """Yield the snapshots whose heads are undamaged, the newest first, with None for each part.

        `position` and `stored_parts` are set to those of the yielded snapshot.  After the last one, they are
        set to the base of the log and to no parts.  Snapshots up to the base do not belong to the map.

        Raises:
            StoreError: The store fails.
        """
        stored_objects = self._store.list(self._snapshot_prefix, self._snapshot_name(self._base))
        for name in reversed([stored_object.name for stored_object in stored_objects]):
            with contextlib.suppress(NotFound, msgspec.MsgspecError):
                stored = _decode_snapshot(self._store.get(name))
                if digest_of(stored.head) == stored.digest:
                    self.position = _number_in(name)
                    self.stored_parts = stored.parts
                    yield MapSnapshot(
                        position=self.position,
                        unmeasured=stored.unmeasured,
                        head=stored.head,
                        parts=dict.fromkeys(stored.parts),
                    )
        self.position, self.stored_parts = self._base, {}

    def read_part(self, name: str) -> bytes:
        """Read the part *name* of the snapshot that `read_snapshots` yielded last.

        Raises:
            NotFound: The part is missing in the store.
            StoreError: The store fails.
        """
        return self._store.get(f"{self._part_prefix}{self.stored_parts.get(name, name)}")

    def read_entries(self) -> Iterator[LogEntry]:
        """Yield the entries after `position` in their order; `position` is set to the number of each.

        Raises:
            StoreError: The store fails, or an entry is missing or damaged.
        """
        for stored_object in self._store.list(self._entry_prefix, self._entry_name(self.position)):
            number = _number_in(stored_object.name)
            if number != self.position + 1:
                raise StoreError(
                    f"entry {self.position + 1} of the log is missing, but {number} is there",
                    hint="restore the store from a backup, or stop the live map: rse-pf map live stop",
                )
            entry = self._read_entry(stored_object.name)
            self.position = number
            yield entry

    def write_entry(self, events: bytes) -> int:
        """Write the next entry durably, with encoded *events*, and return its number.

        Raises:
            LeaseLost: Another process wrote an entry with this number.
            StoreError: The store fails, and the entry may be stored or not; call again with equal *events*.
        """
        number = self.position + 1
        name = self._entry_name(number)
        data = _encode(LogEntry(self._epoch, self._owner, events))
        try:
            self._store.compare_and_swap(name, None, data)
        except Conflict as error:
            # An equal entry is that of an earlier call whose reply was lost, any other that of another
            # process.
            if self._store.get(name) != data:
                raise LeaseLost(f"entry {number} of the log was written by another map server") from error
        self.position = number
        return number

    def has_next_entry(self) -> bool:
        """Return whether the store has an entry after `position`; raises StoreError if the store fails."""
        try:
            self._store.head(self._entry_name(self.position + 1))
        except NotFound:
            return False
        return True

    def write_snapshot(self, snapshot: MapSnapshot) -> None:
        """Write a snapshot durably, and delete snapshots, parts and entries that a restart no longer needs.

        The two newest snapshots stay.  Entries up to the older of both are deleted, or only those up to the
        base of the log if it keeps all.  `stored_parts` is set to the parts of *snapshot*.

        Raises:
            StoreError: The store fails, and the snapshot may be stored or not; or a part of the snapshot is
                neither given nor stored, and the snapshot is not written.
        """
        # 1. Write the parts first, so that a snapshot in the store is always complete.
        parts: dict[str, str] = {}
        for name, data in snapshot.parts.items():
            if data is None:
                if name not in self.stored_parts:
                    raise StoreError(
                        f"the part {name} of the snapshot is not stored",
                        hint="no action is needed: the next snapshot contains this part",
                    )
                parts[name] = self.stored_parts[name]
            else:
                parts[name] = f"{self._epoch:09d}-{name}"
                self._store.put(f"{self._part_prefix}{parts[name]}", data)
        # 2. Write the head of the snapshot.
        stored = _StoredSnapshot(digest_of(snapshot.head), snapshot.unmeasured, snapshot.head, parts)
        self._store.put(self._snapshot_name(snapshot.position), _encode(stored))
        # 3. Delete older snapshots, and then the parts and the entries that only they needed.
        stored_snapshots = self._store.list(self._snapshot_prefix)
        numbers = sorted(_number_in(stored_object.name) for stored_object in stored_snapshots)
        remaining = [number for number in numbers if number > self._base][-_SNAPSHOTS_KEPT:]
        self.stored_parts = parts
        for number in set(numbers) - set(remaining):
            self._store.delete(self._snapshot_name(number))
        self._delete_parts_except_of(remaining)
        if len(remaining) == _SNAPSHOTS_KEPT:
            self._delete_entries_until(remaining[0])

    def charged_bytes(self) -> int:
        """Return for how many bytes of the tenant's quota the log, its snapshots and their parts count.

        Raises:
            StoreError: The store fails.
        """
        prefixes = (self._entry_prefix, self._snapshot_prefix, self._part_prefix)
        return sum(self._store.usage(prefix).charged_bytes for prefix in prefixes)

    def delete_until(self, number: int) -> None:
        """Delete all entries and snapshots up to *number*, at which the map was stopped, and all parts.

        Parts of later epochs stay.

        Raises:
            StoreError: The store fails; the remaining objects are not deleted.
        """
        for prefix in (self._entry_prefix, self._snapshot_prefix):
            for stored_object in list(self._store.list(prefix)):
                if _number_in(stored_object.name) <= number:
                    self._store.delete(stored_object.name)
        self._delete_parts_except_of([])

    def _delete_parts_except_of(self, snapshots: list[int]) -> None:
        """Delete the parts of this and earlier epochs that no snapshot with a number in *snapshots* needs."""
        needed: set[str] = set()
        for number in snapshots:
            with contextlib.suppress(NotFound, msgspec.MsgspecError):
                needed.update(_decode_snapshot(self._store.get(self._snapshot_name(number))).parts.values())
        for stored_object in list(self._store.list(self._part_prefix)):
            part = stored_object.name.removeprefix(self._part_prefix)
            if part not in needed and int(part.partition("-")[0]) <= self._epoch:
                self._store.delete(stored_object.name)

    def _delete_entries_until(self, number: int) -> None:
        """Delete the log entries up to *number*; if the log keeps all, only those up to its base."""
        if self._keeps_all:
            number = min(number, self._base)
        last = self._entry_name(number)
        for stored_object in list(self._store.list(self._entry_prefix)):
            if stored_object.name > last:
                break
            self._store.delete(stored_object.name)

    def _read_entry(self, name: str) -> LogEntry:
        try:
            return _decode_entry(self._store.get(name))
        except msgspec.MsgspecError as error:
            raise StoreError(
                f"the entry {name!r} of the log is damaged", hint="restore the store from a backup"
            ) from error

    def _entry_name(self, number: int) -> str:
        return f"{self._entry_prefix}{number:012d}"

    def _snapshot_name(self, number: int) -> str:
        return f"{self._snapshot_prefix}{number:012d}"


def _number_in(name: str) -> int:
    """Return the number of a log entry or snapshot, which its object name ends with."""
    return int(name.rpartition("/")[2])


@dataclass(slots=True, eq=False)
class SubmittedEvent:
    """An event that waits for the log.

    Attributes:
        event: The event.
        size_bytes: Size of the keyframe in the event; 0 for an event without a keyframe.
        applied: Gets the outcomes of the event when it is durable and applied to the map, or the error with
            which it is refused.
    """

    event: Event
    size_bytes: int
    applied: asyncio.Future[list[Outcome]]


class LogWriter:
    """Writes the submitted events of one live map to its log, one entry at a time.

    All methods are called in the event loop.
    """

    def __init__(
        self,
        log: LiveLog,
        environment: MapServerEnvironment,
        *,
        apply_entry: Callable[[int, list[SubmittedEvent]], Awaitable[None]],
        on_waiting: Callable[[bool], None],
        on_lost: Callable[[str], None],
    ) -> None:
        """Write nothing until `run` is called.

        Args:
            log: Log of the map.
            environment: Environment of the map server.
            apply_entry: Called with the number and the events of each entry when it is durable; applies the
                events to the map and completes each ``applied``.
            on_waiting: Called during and after each try to write an entry: with True if the try takes longer
                than 1 s, or if the second or a later try for the same entry has failed, else with False.
            on_lost: Called with a reason when another process has taken the map over.
        """
        self._log = log
        self._environment = environment
        self._apply_entry = apply_entry
        self._on_waiting = on_waiting
        self._on_lost = on_lost
        self._queue: deque[SubmittedEvent] = deque()
        self._has_events = asyncio.Event()
        self._outstanding: set[asyncio.Future[list[Outcome]]] = set()

    def submit(self, event: Event, size_bytes: int = 0) -> asyncio.Future[list[Outcome]]:
        """Queue *event* for the log and return a future for its outcomes.

        The future is done when the event is durable and applied to the map, or fails with the error with
        which the event is refused.  Callers await it by `asyncio.shield`, so that it is never cancelled: an
        event cannot be withdrawn.

        Args:
            event: Keyframe or other event.
            size_bytes: Size of the keyframe in the event; 0 for an event without one.

        Raises:
            Busy: The event is a keyframe, and 1,024 events wait for the store.
        """
        if len(self._queue) >= _MAX_QUEUED_EVENTS and isinstance(event, KeyframeAdded):
            raise Busy(
                f"{len(self._queue)} events of the live map wait for the object store",
                hint="send the keyframe again after retry_after_ms",
                retry_after_ms=BUSY_RETRY_MS,
            )
        submitted = SubmittedEvent(event, size_bytes, asyncio.get_running_loop().create_future())
        # Read the exception in any case, since a cancelled request does not, and asyncio logs unread ones.
        submitted.applied.add_done_callback(lambda future: future.exception())
        self._outstanding.add(submitted.applied)
        submitted.applied.add_done_callback(self._outstanding.discard)
        self._queue.append(submitted)
        self._has_events.set()
        return submitted.applied

    async def wait_empty(self) -> None:
        """Wait until every event that was submitted before this call is applied or refused."""
        if self._outstanding:
            await asyncio.wait(set(self._outstanding))

    def refuse_all(self, make_error: Callable[[], RsePfError]) -> None:
        """Fail all events that are not applied yet with an error made by *make_error*."""
        for future in list(self._outstanding):
            if not future.done():
                future.set_exception(make_error())

    async def run(self) -> None:
        """Write queued events to the log, and have them applied, until this task is cancelled.

        If the store has no space for an entry, its keyframes are refused, and its other events are written
        without them.
        """
        while True:
            await self._has_events.wait()
            batch = self._next_batch()
            if not self._queue:
                self._has_events.clear()
            try:
                position = await self._make_durable(batch)
            except StoreFull as error:
                batch = _refuse_keyframes(batch, error)
                if not batch:
                    continue
                position = await self._make_durable(batch)
            await self._apply_entry(position, batch)

    def _next_batch(self) -> list[SubmittedEvent]:
        """Take the events of the next entry from the queue: at least one, as many as the limits allow."""
        batch = [self._queue.popleft()]
        size_bytes = batch[0].size_bytes
        while self._queue and len(batch) < _MAX_ENTRY_EVENTS:
            size_bytes += self._queue[0].size_bytes
            if size_bytes > _MAX_ENTRY_BYTES:
                break
            batch.append(self._queue.popleft())
        return batch

    async def _make_durable(self, batch: list[SubmittedEvent]) -> int:
        """Write *batch* as the next entry, retry while the store fails, and return the entry's number.

        Every try writes the same bytes, because the entry of a failed try may be stored.  If another process
        has written an entry with this number, ``on_lost`` is called, and this method waits until it is
        cancelled.

        Raises:
            StoreFull: There is no space for the keyframes of *batch*, and the entry was not stored.
        """
        environment = self._environment
        data = encode_events([submitted.event for submitted in batch])
        has_keyframes = any(isinstance(submitted.event, KeyframeAdded) for submitted in batch)
        wait_s = FIRST_RETRY_S
        while True:
            write = asyncio.ensure_future(environment.threads.store(lambda: self._log.write_entry(data)))
            try:
                await asyncio.wait({write}, timeout=SLOW_STORE_S)
                self._on_waiting(not write.done())
                position = await write
            except LeaseLost as error:
                self._on_lost(error.message)
                await asyncio.Event().wait()
            except StoreError as error:
                if isinstance(error, StoreFull) and has_keyframes and await self._is_entry_missing():
                    raise
                environment.log.warning("live-log-retry", map=environment.map_name, error=error.message)
                self._on_waiting(wait_s > FIRST_RETRY_S)
                await environment.sleep(wait_s)
                wait_s = next_retry_s(wait_s)
            else:
                self._on_waiting(False)
                return position

    async def _is_entry_missing(self) -> bool:
        """Return whether the log certainly has no next entry, so that other events may be written there.

        The answer is False if the store fails.
        """
        try:
            return not await self._environment.threads.store(self._log.has_next_entry)
        except StoreError:
            return False


def _refuse_keyframes(batch: list[SubmittedEvent], error: StoreFull) -> list[SubmittedEvent]:
    """Fail the keyframes of *batch* with *error*, so that robots send them again; return the other events."""
    for submitted in batch:
        if isinstance(submitted.event, KeyframeAdded):
            submitted.applied.set_exception(error)
    return [submitted for submitted in batch if not isinstance(submitted.event, KeyframeAdded)]
