"""Publish a live map to the registry: one version in an interval at most, and no version twice.

The registry says when the last version was made, so the interval also counts over owners.  An owner does not
know whether the one before it published all: it publishes once, and a version that exists is not written
again.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Callable

from rse_pf.backend.live_map.owner.publish import publish_version
from rse_pf.backend.live_map.owner.state import MapState
from rse_pf.backend.live_map.owner.work.threads import Threads, Urgency
from rse_pf.backend.live_map.owner.work.waits import Sleep
from rse_pf.backend.log import JsonLog
from rse_pf.errors import Busy, NotFound, RsePfError, StoreError
from rse_pf.maps.registry import MapRecord, MapRegistry

__all__ = ["Publisher"]

_MOST_WAIT_S = 10.0
"""Who asks for a version waits for so long; who would wait longer is told when to ask again."""
_FIRST_RETRY_S, _LAST_RETRY_S = 5.0, 600.0
"""A version that could not be stored is tried again after these times; encoding a large map takes seconds."""
_NEVER = -1


class Publisher:
    """Publishes one map; its methods are called in the event loop."""

    def __init__(
        self, state: MapState, maps: MapRegistry, *, threads: Threads, clock: Callable[[], float],
        wall_clock: Callable[[], float], sleep: Sleep, pause_s: float, json_log: JsonLog, name: str,
        author: str, charge: Callable[[int, int], None],
    ) -> None:  # fmt: skip
        """Publish nothing yet.

        Args:
            state: The map.
            maps: The registry.
            threads: In which to compute and wait.
            clock: Seconds, monotonic.
            wall_clock: Unix seconds.
            sleep: Waits for seconds.
            pause_s: Shortest time between two versions.
            json_log: Of the server.
            name: Of the map.
            author: Of the versions.
            charge: Gets the bytes of a version before they are written, and how many are removed for them;
                refuses by an error.
        """
        self._state, self._maps, self._threads = state, maps, threads
        self._clock, self._wall_clock, self._sleep, self._pause_s = clock, wall_clock, sleep, pause_s
        self._json_log, self._name, self._author = json_log, name, author
        self._charge = charge
        self._lock = asyncio.Lock()
        self._published = _NEVER
        self._last_record: MapRecord | None = None
        self._free_s: float | None = None
        self._due = ""
        self.has_failed = False
        """Whether what is due could not be published when its time had come; it stays due."""
        self._retry_s, self._retry_at_s = _FIRST_RETRY_S, float("-inf")

    @property
    def is_due(self) -> bool:
        """Whether a version that was asked for waits for its time."""
        return bool(self._due) and self._is_changed

    async def publish(self, note: str, freed: int = 0) -> MapRecord:
        """Publish the map unless its newest version was published already; return its record.

        Args:
            note: Why.
            freed: Bytes of the map's log that are removed for the version.

        Raises:
            QuotaExceeded, StoreFull: The version does not fit into what the tenant may store.
            Busy: The last version is too young; ``retry_after_ms`` says when to ask again.
            NotFound: The map is empty.
        """
        async with self._lock:
            if not self._state.keyframes:
                raise NotFound(f"the live map {self._name!r} is empty", hint="drive a robot first")
            if self._last_record is not None and not self._is_changed:
                return self._last_record
            wait_s = await self._wait_s()
            if wait_s > _MOST_WAIT_S:
                raise Busy(
                    f"the live map {self._name!r} was published less than {self._pause_s:.0f} s ago",
                    hint="ask again then, or lower live.publish_pause_s", retry_after_ms=1e3 * wait_s,
                )  # fmt: skip
            if wait_s > 0:
                await self._sleep(wait_s)
            return await self._publish(note, freed)

    def ask(self, note: str) -> None:
        """Note that the map is to be published if it has changed, as soon as the interval allows it."""
        if not self.is_due:
            self.has_failed = False
        self._due = note

    async def publish_due(self) -> None:
        """Publish what `ask` noted if its time has come; an error is logged, and it stays due."""
        if not self.is_due or self._lock.locked() or self._clock() < self._retry_at_s:
            return
        with contextlib.suppress(StoreError):  # it is asked again
            if await self._wait_s() <= 0:
                await self.publish_now()

    async def publish_now(self) -> None:
        """Publish what is due, also before its time: the owner ends."""
        if not self.is_due:
            return
        try:
            async with self._lock:
                if self._is_changed:
                    await self._publish(self._due)
        except RsePfError as error:
            self._json_log.warning("live-publish-failed", map=self._name, error=error.message)
            self.has_failed = True
            self._retry_at_s = self._clock() + self._retry_s
            self._retry_s = min(_LAST_RETRY_S, 2 * self._retry_s)

    @property
    def _is_changed(self) -> bool:
        return self._state.keyframes > 0 and self._state.changes != self._published

    async def _publish(self, note: str, freed: int = 0) -> MapRecord:
        changes = self._state.changes
        version = await self._threads.compute(Urgency.BACKGROUND, self._state.live_map.to_version)
        publish = functools.partial(
            publish_version, self._maps, self._name, version, author=self._author,
            created_s=self._wall_clock(), note=note, charge=lambda size: self._charge(size, freed),
        )  # fmt: skip
        record = await self._threads.background(publish)
        self._free_s = self._clock() + self._pause_s
        self._published, self._last_record = changes, record
        self.has_failed, self._retry_s = False, _FIRST_RETRY_S
        self._json_log.info("live-map-published", map=self._name, id=record.id, number=record.number)
        return record

    async def _wait_s(self) -> float:
        """Return for how long no version may be published."""
        if self._free_s is None:
            age_s = await self._threads.background(self._age_s)
            self._free_s = self._clock() + max(0.0, self._pause_s - max(0.0, age_s))
        return self._free_s - self._clock()

    def _age_s(self) -> float:
        """Return how old the newest version is; blocking."""
        try:
            return self._wall_clock() - self._maps.head(self._name).created_s
        except NotFound:
            return float("inf")
