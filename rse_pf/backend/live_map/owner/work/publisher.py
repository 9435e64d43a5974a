"""Publish a live map to the registry, unless its newest version is there already."""

from __future__ import annotations

from collections.abc import Callable

from rse_pf.backend.live_map.owner.publish import publish_version
from rse_pf.backend.live_map.owner.state import MapState
from rse_pf.backend.live_map.owner.work.threads import Threads, Urgency
from rse_pf.backend.log import JsonLog
from rse_pf.errors import NotFound, RsePfError
from rse_pf.maps.registry import MapRecord, MapRegistry

__all__ = ["Publisher"]


class Publisher:
    """Publishes one map; its methods are called in the event loop."""

    def __init__(
        self, state: MapState, maps: MapRegistry, *, threads: Threads, wall_clock: Callable[[], float],
        json_log: JsonLog, name: str, author: str,
    ) -> None:  # fmt: skip
        """Publish nothing yet.

        Args:
            state: The map.
            maps: The registry.
            threads: In which to compute and wait.
            wall_clock: Unix seconds.
            json_log: Of the server.
            name: Of the map.
            author: Of the versions.
        """
        self._state, self._maps, self._threads = state, maps, threads
        self._wall_clock, self._json_log, self._name, self._author = wall_clock, json_log, name, author
        self._published = 0
        self._last_record: MapRecord | None = None

    async def publish(self, note: str) -> MapRecord:
        """Publish the map unless its newest version was published already; return its record.

        Raises:
            NotFound: The map is empty.
        """
        changes = self._state.changes
        if self._last_record is not None and changes == self._published:
            return self._last_record
        if not self._state.keyframes:
            raise NotFound(f"the live map {self._name!r} is empty", hint="drive a robot first")
        version = await self._threads.compute(Urgency.BACKGROUND, self._state.live_map.to_version)
        record = await self._threads.background(
            lambda: publish_version(
                self._maps, self._name, version, author=self._author, created_s=self._wall_clock(), note=note
            )
        )
        self._published, self._last_record = changes, record
        self._json_log.info("live-map-published", map=self._name, id=record.id, number=record.number)
        return record

    async def publish_quietly(self, note: str) -> None:
        """Publish the map if it has changed; an error is logged."""
        try:
            if self._state.changes != self._published:
                await self.publish(note)
        except NotFound:
            pass
        except RsePfError as error:
            self._json_log.warning("live-publish-failed", map=self._name, error=error.message)
