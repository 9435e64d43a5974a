"""The log of a live map in the object store: numbered entries that are written once, and snapshots.

Events that arrive during a write share the next entry, and are applied in the order of the log when they are
durable.

An entry is created by compare-and-swap, so that two owners never write one number: an owner that finds its
number taken is the owner no longer.  Nothing is changed after it was written.  Snapshots shorten a restart;
entries before the older one are deleted.

Layout, below ``live/TENANT/MAP/``: ``log/NUMBER`` from 1 on, ``snapshot/NUMBER`` after that entry, and
``features/EPOCH-SHA256``, parts that snapshots share.  An owner deletes no part of a later owner, since its
snapshot may not be written yet.
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
from rse_pf.object_store import ObjectStore, digest_of
from rse_pf.server.live_map.owner.threads import FIRST_RETRY_S, OwnerThreads, Sleep, next_retry_s
from rse_pf.server.log import JsonLog

__all__ = [
    "BUSY_RETRY_MS",
    "SLOW_STORE_S",
    "EntryWriter",
    "LiveLog",
    "LogEntry",
    "MapSnapshot",
    "OwnershipLost",
    "Submitted",
    "snapshot_entries",
]

_LEAST_ENTRIES, _MOST_ENTRIES = 40, 200
_ENTRIES_OF_KEYFRAME = 0.25
_KEPT_SNAPSHOTS = 2
_MAX_ENTRY_EVENTS, _MAX_ENTRY_BYTES = 64, 4 << 20
_MAX_WAITING_EVENTS = 1024
SLOW_STORE_S = 1.0
"""A write that takes longer is told to the robots."""
BUSY_RETRY_MS = 200.0


class OwnershipLost(Conflict):
    """Another process owns the map: it wrote the entry, or the lease, that this one was about to write.

    Cause: The owner was paused or cut off from the store for longer than live.lease_s.
    Check: The log of the servers: which one owns the map now.
    Fix: Nothing; robots are served by the new owner.
    """


class LogEntry(msgspec.Struct, frozen=True, array_like=True):
    """One entry: who wrote it, and its events as `encode_events` returns them."""

    epoch: int
    owner: str
    events: bytes


class _Stored(msgspec.Struct, frozen=True, array_like=True):
    digest: str
    unmeasured: tuple[int, ...]
    head: bytes
    parts: dict[str, str] = {}


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSnapshot:
    """The map after the entry ``position``.

    ``unmeasured`` are its keyframes whose links are not logged.  ``parts`` are what ``head`` needs, by name;
    those that the store has already are None.
    """

    position: int
    unmeasured: tuple[int, ...]
    head: bytes
    parts: Mapping[str, bytes | None] = field(default_factory=dict)


_encode = msgspec.msgpack.Encoder().encode
_decode_entry = msgspec.msgpack.Decoder(LogEntry).decode
_decode_snapshot = msgspec.msgpack.Decoder(_Stored).decode


def snapshot_entries(keyframes: int) -> int:
    """Return how many entries after a snapshot of a map of *keyframes* the next one is made.

    A restart reads them again, 2 to 4 ms each, and a snapshot costs more the larger the map is.
    """
    return round(min(_MOST_ENTRIES, max(_LEAST_ENTRIES, _ENTRIES_OF_KEYFRAME * keyframes)))


class LiveLog:
    """The entries and snapshots of one map.  Blocking; entries and snapshots may have a thread each."""

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
        """Read nothing yet.

        Args:
            store: Shared by all servers.
            folder: `map_folder` of the map.
            owner: Who writes.
            epoch: Its number.
            base: Entries up to this position do not belong to the map.
            keeps_all: Delete no entry.
        """
        self.position = base
        self.stored_parts: dict[str, str] = {}
        """The objects of the parts of the newest snapshot that was read or written, by name."""
        self._store = store
        self._entries, self._snapshots = f"{folder}log/", f"{folder}snapshot/"
        self._parts = f"{folder}features/"
        self._owner, self._epoch = owner, epoch
        self._base = base
        self._keeps_all = keeps_all

    def snapshots(self) -> Iterator[MapSnapshot]:
        """Yield the snapshots that are whole, the newest first; `position` follows them, at last to the base.

        Raises:
            StoreError: The store fails.
        """
        names = [info.name for info in self._store.list(self._snapshots, self._snapshot_name(self._base))]
        for name in reversed(names):
            with contextlib.suppress(NotFound, msgspec.MsgspecError):
                stored = _decode_snapshot(self._store.get(name))
                if digest_of(stored.head) == stored.digest:
                    self.position = _number_of(name)
                    self.stored_parts = stored.parts
                    yield MapSnapshot(
                        position=self.position, unmeasured=stored.unmeasured, head=stored.head,
                        parts=dict.fromkeys(stored.parts),
                    )  # fmt: skip
        self.position, self.stored_parts = self._base, {}

    def part(self, name: str) -> bytes:
        """Return a part of the snapshot that `snapshots` yielded last; raises NotFound and StoreError."""
        return self._store.get(f"{self._parts}{self.stored_parts.get(name, name)}")

    def entries(self) -> Iterator[LogEntry]:
        """Yield the entries after `position`, which follows them.

        Raises:
            StoreError: The store fails, or an entry is missing or damaged.
        """
        for info in self._store.list(self._entries, self._entry_name(self.position)):
            number = _number_of(info.name)
            if number != self.position + 1:
                raise StoreError(
                    f"entry {self.position + 1} of the log is missing, but {number} is there",
                    hint="restore the store from a backup, or stop the live map",
                )
            entry = self._read(info.name)
            self.position = number
            yield entry

    def write(self, events: bytes) -> int:
        """Write the next entry durably and return its number.

        After a StoreError the same events must be written again: the entry may be there.

        Raises:
            OwnershipLost: Another process wrote this number.
            StoreError: The store fails.
        """
        number = self.position + 1
        name = self._entry_name(number)
        data = _encode(LogEntry(self._epoch, self._owner, events))
        try:
            self._store.compare_and_swap(name, None, data)
        except Conflict as error:
            if self._store.get(name) != data:  # else an earlier write whose answer was lost
                raise OwnershipLost(f"entry {number} of the log was written by another owner") from error
        self.position = number
        return number

    def holds_next(self) -> bool:
        """Return whether the entry after `position` exists; raises StoreError."""
        try:
            self._store.head(self._entry_name(self.position + 1))
        except NotFound:
            return False
        return True

    def write_snapshot(self, snapshot: MapSnapshot) -> None:
        """Write a snapshot durably, and delete what a restart no longer needs; raises StoreError."""
        parts: dict[str, str] = {}
        for name, data in snapshot.parts.items():
            if data is None:
                if name not in self.stored_parts:
                    raise StoreError("a part of the snapshot is not stored", hint="the next one has it")
                parts[name] = self.stored_parts[name]
            else:
                parts[name] = f"{self._epoch:09d}-{name}"
                self._store.put(f"{self._parts}{parts[name]}", data)
        stored = _Stored(digest_of(snapshot.head), snapshot.unmeasured, snapshot.head, parts)
        self._store.put(self._snapshot_name(snapshot.position), _encode(stored))
        numbers = sorted(_number_of(info.name) for info in self._store.list(self._snapshots))
        kept = [number for number in numbers if number > self._base][-_KEPT_SNAPSHOTS:]
        self.stored_parts = parts
        for number in set(numbers) - set(kept):
            self._store.delete(self._snapshot_name(number))
        self._delete_parts(kept)
        if len(kept) == _KEPT_SNAPSHOTS:
            self._delete_entries(kept[0])

    def charged_bytes(self) -> int:
        """Return for how much of the tenant's quota log, snapshots and parts count; raises StoreError."""
        areas = (self._entries, self._snapshots, self._parts)
        return sum(self._store.usage(area).charged_bytes for area in areas)

    def delete_until(self, number: int) -> None:
        """Delete entries and snapshots up to *number*: the map was stopped there; raises StoreError."""
        for prefix in (self._entries, self._snapshots):
            for info in list(self._store.list(prefix)):
                if _number_of(info.name) <= number:
                    self._store.delete(info.name)
        self._delete_parts([])

    def _delete_parts(self, snapshots: list[int]) -> None:
        """Delete the parts that none of these snapshots needs."""
        needed: set[str] = set()
        for number in snapshots:
            with contextlib.suppress(NotFound, msgspec.MsgspecError):
                needed.update(_decode_snapshot(self._store.get(self._snapshot_name(number))).parts.values())
        for info in list(self._store.list(self._parts)):
            name = info.name.removeprefix(self._parts)
            if name not in needed and int(name.partition("-")[0]) <= self._epoch:
                self._store.delete(info.name)

    def _delete_entries(self, until: int) -> None:
        if self._keeps_all:
            until = min(until, self._base)
        last = self._entry_name(until)
        for info in list(self._store.list(self._entries)):
            if info.name > last:
                break
            self._store.delete(info.name)

    def _read(self, name: str) -> LogEntry:
        try:
            return _decode_entry(self._store.get(name))
        except msgspec.MsgspecError as error:
            raise StoreError(f"{name!r} is damaged", hint="restore the store from a backup") from error

    def _entry_name(self, number: int) -> str:
        return f"{self._entries}{number:012d}"

    def _snapshot_name(self, number: int) -> str:
        return f"{self._snapshots}{number:012d}"


def _number_of(name: str) -> int:
    return int(name.rpartition("/")[2])


@dataclass(slots=True, eq=False)
class Submitted:
    """An event that shall enter the log; ``done`` holds its outcomes when it is durable and applied."""

    event: Event
    size: int
    done: asyncio.Future[list[Outcome]]


class EntryWriter:
    """Writes the entries of one map; its methods are called in the event loop."""

    def __init__(
        self,
        log: LiveLog,
        *,
        take_entry: Callable[[int, list[Submitted]], Awaitable[None]],
        on_waiting: Callable[[bool], None],
        on_lost: Callable[[str], None],
        threads: OwnerThreads,
        sleep: Sleep,
        json_log: JsonLog,
        name: str,
    ) -> None:
        """Write nothing until `run`.

        Args:
            log: Of the map.
            take_entry: Applies the events of a durable entry, and sets what is done.
            on_waiting: Called with whether the store is slow or fails.
            on_lost: Called with the reason when another process owns the map.
            threads: One of them writes.
            sleep: Waits for seconds.
            json_log: Of the server.
            name: Of the map, for `json_log`.
        """
        self._log, self._threads = log, threads
        self._take_entry, self._on_waiting, self._on_lost = take_entry, on_waiting, on_lost
        self._sleep, self._json_log, self._name = sleep, json_log, name
        self._queue: deque[Submitted] = deque()
        self._queued = asyncio.Event()
        self._outstanding: set[asyncio.Future[list[Outcome]]] = set()

    def submit(self, event: Event, size: int = 0) -> asyncio.Future[list[Outcome]]:
        """Let *event* enter the log; the future holds its outcomes when it is durable and applied.

        Raises:
            Busy: Too many keyframes wait for the store.
        """
        if len(self._queue) >= _MAX_WAITING_EVENTS and isinstance(event, KeyframeAdded):
            raise Busy("the live map cannot store more now", hint="wait", retry_after_ms=BUSY_RETRY_MS)
        submitted = Submitted(event, size, asyncio.get_running_loop().create_future())
        submitted.done.add_done_callback(lambda done: done.cancelled() or done.exception())
        self._outstanding.add(submitted.done)
        submitted.done.add_done_callback(self._outstanding.discard)
        self._queue.append(submitted)
        self._queued.set()
        return submitted.done

    async def wait_empty(self) -> None:
        """Wait until all that was submitted until now is applied."""
        if self._outstanding:
            await asyncio.wait(set(self._outstanding))

    def refuse_all(self, error: Callable[[], RsePfError]) -> None:
        """End what waits with an *error*."""
        for future in list(self._outstanding):
            if not future.done():
                future.set_exception(error())

    async def run(self) -> None:
        """Write until cancelled."""
        while True:
            await self._queued.wait()
            batch = self._next_batch()
            if not self._queue:
                self._queued.clear()
            try:
                position = await self._make_durable(batch)
            except StoreFull as error:
                batch = _without_keyframes(batch, error)
                if not batch:
                    continue
                position = await self._make_durable(batch)
            await self._take_entry(position, batch)

    def _next_batch(self) -> list[Submitted]:
        batch = [self._queue.popleft()]
        size = batch[0].size
        while self._queue and len(batch) < _MAX_ENTRY_EVENTS:
            size += self._queue[0].size
            if size > _MAX_ENTRY_BYTES:
                break
            batch.append(self._queue.popleft())
        return batch

    async def _make_durable(self, batch: list[Submitted]) -> int:
        """Write the next entry, however long the store fails; the same bytes each time.

        Raises:
            StoreFull: There is no space for the keyframes in *batch*; the entry does not exist.
        """
        data = encode_events([each.event for each in batch])
        has_keyframes = any(isinstance(each.event, KeyframeAdded) for each in batch)
        wait_s = FIRST_RETRY_S
        while True:
            write = asyncio.ensure_future(self._threads.store(lambda: self._log.write(data)))
            try:
                await asyncio.wait({write}, timeout=SLOW_STORE_S)
                self._on_waiting(not write.done())
                position = await write
            except OwnershipLost as error:
                self._on_lost(error.message)
                await asyncio.Event().wait()
            except StoreError as error:
                if isinstance(error, StoreFull) and has_keyframes and await self._is_missing():
                    raise
                self._json_log.warning("live-log-retry", map=self._name, error=error.message)
                self._on_waiting(wait_s > FIRST_RETRY_S)
                await self._sleep(wait_s)
                wait_s = next_retry_s(wait_s)
            else:
                self._on_waiting(False)
                return position

    async def _is_missing(self) -> bool:
        """Return whether the next entry does surely not exist, so that it may hold something else."""
        try:
            return not await self._threads.store(self._log.holds_next)
        except StoreError:
            return False


def _without_keyframes(batch: list[Submitted], error: StoreFull) -> list[Submitted]:
    """Refuse the keyframes of *batch*, and return what is left: short events, which nothing can replace."""
    for each in batch:
        if isinstance(each.event, KeyframeAdded) and not each.done.done():
            each.done.set_exception(error)
    return [each for each in batch if not isinstance(each.event, KeyframeAdded)]
