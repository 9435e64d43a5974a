"""The events of a map become entries of its log, and are applied when they are durable, one entry at a time.

What arrives during a write shares the next entry.  Events are applied in the order of the log.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from rse_pf.backend.live_map.owner.log import LiveLog, OwnershipLost
from rse_pf.backend.live_map.owner.work.threads import Threads
from rse_pf.backend.live_map.owner.work.waits import FIRST_RETRY_S, Sleep, next_retry_s
from rse_pf.backend.log import JsonLog
from rse_pf.errors import Busy, RsePfError, StoreError, StoreFull
from rse_pf.live_map.events import Event, KeyframeAdded, encode_events
from rse_pf.live_map.outcomes import Outcome

__all__ = ["BUSY_RETRY_MS", "SLOW_STORE_S", "EntryTaker", "EntryWriter", "Submitted"]

_MAX_ENTRY_EVENTS, _MAX_ENTRY_BYTES = 64, 4 << 20
_MAX_WAITING_EVENTS = 1024
SLOW_STORE_S = 1.0
"""A write that takes longer is told to the robots."""
BUSY_RETRY_MS = 200.0


@dataclass(slots=True, eq=False)
class Submitted:
    """An event that shall enter the log; ``done`` holds its outcomes when it is durable and applied."""

    event: Event
    size: int
    done: asyncio.Future[list[Outcome]]


class EntryTaker(Protocol):
    """Who holds the map."""

    async def take_entry(self, position: int, batch: list[Submitted]) -> None:
        """Apply the events of an entry that is durable, and set what is done."""

    def note_store(self, *, is_waiting: bool) -> None:
        """Take whether the store is slow or fails."""

    def lose(self, reason: str) -> None:
        """Take that another process owns the map."""


class EntryWriter:
    """Writes the entries of one map; its methods are called in the event loop."""

    def __init__(
        self, log: LiveLog, taker: EntryTaker, *, threads: Threads, sleep: Sleep, json_log: JsonLog, name: str
    ) -> None:
        """Write nothing until `run`.

        Args:
            log: Of the map.
            taker: Gets each entry.
            threads: One of them writes.
            sleep: Waits for seconds.
            json_log: Of the server.
            name: Of the map, for `json_log`.
        """
        self._log, self._taker, self._threads = log, taker, threads
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
            await self._taker.take_entry(position, batch)

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
                self._taker.note_store(is_waiting=not write.done())
                position = await write
            except OwnershipLost as error:
                self._taker.lose(error.message)
                await asyncio.Event().wait()
            except StoreError as error:
                if isinstance(error, StoreFull) and has_keyframes and await self._is_missing():
                    raise
                self._json_log.warning("live-log-retry", map=self._name, error=error.message)
                self._taker.note_store(is_waiting=wait_s > FIRST_RETRY_S)
                await self._sleep(wait_s)
                wait_s = next_retry_s(wait_s)
            else:
                self._taker.note_store(is_waiting=False)
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
