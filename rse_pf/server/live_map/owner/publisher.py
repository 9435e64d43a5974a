"""Publish a live map to the registry: one version in an interval at most, and no version twice.

The registry says when the last version was made, so the interval also counts over owners.  An owner does not
know whether the one before it published all: it publishes once, and a version that exists is not written
again.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence

from rse_pf.errors import (
    BadMessage,
    BadRequest,
    Busy,
    Conflict,
    LimitExceeded,
    NotFound,
    RsePfError,
    StoreError,
)
from rse_pf.live_map.versions import PointSource, as_internal_error
from rse_pf.maps.format import UP_FIELD, MapVersion, encode_map
from rse_pf.maps.registry import MapOrigin, MapRecord, MapRegistry
from rse_pf.maps.removal import superseded
from rse_pf.object_store import digest_of
from rse_pf.server.live_map.owner.context import OwnerContext
from rse_pf.server.live_map.owner.state import MapState
from rse_pf.server.live_map.owner.threads import Urgency
from rse_pf.wire.live_map import LiveStart

__all__ = ["AUTOMATIC_NOTES", "Publisher", "version_to_start_from"]

AUTOMATIC_NOTES = ("the last robot left", "live map", "nobody used the live map")
"""Notes of versions that nobody asked for: all robots left, time passed, nobody used the map."""
_AUTHOR = "live map on "
_QUOTA_SHARE = 4
"""The versions of one map that nobody asked for take at most this part of the tenant's quota."""
_REMOVED_AT_ONCE = 10
"""A publication removes no more, so that it ends soon, also when the server drains."""

_MOST_WAIT_S = 10.0
"""Who asks for a version waits for so long; who would wait longer is told when to ask again."""
_FIRST_RETRY_S, _LAST_RETRY_S = 5.0, 600.0
"""A version that could not be stored is tried again after these times; encoding a large map takes seconds."""
_NEVER = -1
_TRIES = 5


class Publisher:
    """Publishes one map; its methods are called in the event loop."""

    def __init__(self, state: MapState, context: OwnerContext, *, server: str) -> None:
        """Publish nothing yet.

        Args:
            state: The map.
            context: Of its owner; the tenant is charged with a version before it is written.
            server: On which it runs, and which the versions name as their author.
        """
        self._state, self._context, self._author = state, context, _AUTHOR + server
        self._maps, self._threads = context.maps, context.threads
        self._up_of: tuple[str, list[float] | None] = "", None
        self._clock, self._json_log, self._name = context.clock, context.log, context.map_name
        self._pause_s = context.settings.publish_pause_s
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
                await self._context.sleep(wait_s)
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
        version = await self._make_version()
        version = await self._threads.background(functools.partial(self._with_up, version))
        made_s = self._context.wall_clock()
        origin = MapOrigin(parent=None, author=self._author, created_s=made_s, note=note)
        charge = functools.partial(self._context.account.reserve, freed=freed)
        publish = functools.partial(_publish_version, self._maps, self._name, version, origin, charge)
        record = await self._threads.background(publish)
        self._free_s = self._clock() + self._pause_s
        self._published, self._last_record = changes, record
        self.has_failed, self._retry_s = False, _FIRST_RETRY_S
        self._json_log.info("live-map-published", map=self._name, id=record.id, number=record.number)
        try:
            removed = await self._threads.background(self._remove_old_versions)
        except RsePfError as error:  # they are removed after the next version
            self._json_log.warning("live-versions-not-removed", map=self._name, error=error.message)
        else:
            if removed:
                self._json_log.info("live-versions-removed", map=self._name, removed=removed)
        return record

    async def _make_version(self) -> MapVersion:
        """Return the map with its cloud; made anew if a robot is forgotten while its points are read."""
        compute, live_map, objects = self._threads.compute, self._state.live_map, self._context.objects

        def make() -> tuple[MapVersion, tuple[PointSource, ...], list[tuple[str, str]]]:
            version = live_map.to_version()
            if self._context.settings.images:
                provenance = {**version.provenance, **live_map.image_references(version)}
                version = dataclasses.replace(version, provenance=provenance)
            return version, live_map.point_sources(version), live_map.deletable_objects

        while True:
            version, sources, gone = await compute(Urgency.BACKGROUND, make)
            await self._threads.background(functools.partial(objects.delete_gone, gone))
            if not sources:
                return version
            cloud = await self._threads.background(functools.partial(objects.cloud, sources))
            if await compute(Urgency.BACKGROUND, lambda: live_map.deletable_objects) == gone:
                break
        self._json_log.info(
            "live-cloud", map=self._name, points=len(cloud.points), keyframes=cloud.keyframes,
            missing=cloud.missing,
        )  # fmt: skip
        return dataclasses.replace(version, points=cloud.points, colours=cloud.colours)

    def _with_up(self, version: MapVersion) -> MapVersion:
        """Return *version* with up of the one that it started from, whose axes it keeps.  Blocking.

        Raises:
            StoreError: The store fails.
        """
        source = str(version.provenance.get("from", ""))
        if self._up_of[0] != source:
            up = None
            with contextlib.suppress(NotFound, BadRequest, BadMessage, LimitExceeded):  # it was removed
                name, _, number = source.partition("@")
                up = self._maps.load(name, number).up
            self._up_of = source, None if up is None else up.tolist()
        if self._up_of[1] is None:
            return version
        return dataclasses.replace(version, provenance={**version.provenance, UP_FIELD: self._up_of[1]})

    def _remove_old_versions(self) -> int:
        """Remove the oldest versions that nobody asked for, ten at most; return how many.  Blocking.

        Raises:
            Busy, StoreError: The rest is removed after the next publication.
        """
        keep, account = self._context.settings.keep_versions, self._context.account
        if not keep:
            return 0
        most_bytes = account.quota_bytes() / _QUOTA_SHARE

        def choose(records: Sequence[MapRecord], head: str) -> list[MapRecord]:
            old = superseded(records, head, keep=keep, most_bytes=most_bytes, counts=_is_automatic)
            return old[:_REMOVED_AT_ONCE]

        removed = self._maps.remove(self._name, choose)
        for record in removed:
            account.release(record.size)
        return len(removed)

    async def _wait_s(self) -> float:
        """Return for how long no version may be published."""
        if self._free_s is None:
            age_s = await self._threads.background(self._age_s)
            self._free_s = self._clock() + max(0.0, self._pause_s - max(0.0, age_s))
        return self._free_s - self._clock()

    def _age_s(self) -> float:
        """Return how old the newest version is; blocking."""
        try:
            return self._context.wall_clock() - self._maps.head(self._name).created_s
        except NotFound:
            return float("inf")


def _is_automatic(record: MapRecord) -> bool:
    return record.author.startswith(_AUTHOR) and record.note in AUTOMATIC_NOTES


def _publish_version(
    maps: MapRegistry, name: str, version: MapVersion, origin: MapOrigin, charge: Callable[[int], None]
) -> MapRecord:
    """Make *version* the head of map *name* and return its record; the head itself if it is the same map.

    Blocking; the parent in *origin* becomes the head of now.

    Raises:
        QuotaExceeded, StoreFull: What *charge* raises for the bytes that the version adds to the store.
        Conflict: Others move the head all the time.
        InternalError: The registry takes no such map.
        StoreError: The store fails.
    """
    with as_internal_error("the live map cannot be published"):
        data = encode_map(version)
        digest = digest_of(data)
        for tries_left in reversed(range(_TRIES)):
            try:
                head: MapRecord | None = maps.head(name)
            except NotFound:
                head = None
            if head is not None and head.digest == digest:
                return head
            origin = dataclasses.replace(origin, parent=None if head is None else head.id)
            try:
                return maps.commit_charged(name, data, origin, charge=charge)
            except Conflict:
                if not tries_left:
                    raise
    raise AssertionError("the last try returns or raises")


def version_to_start_from(maps: MapRegistry, request: LiveStart) -> tuple[MapVersion, str]:
    """Return the version that *request* names, and its full name ``MAP@ID``.

    Raises:
        InternalError: The version is damaged.
        NotFound: There is no such map or version.
    """
    name, version = request.source_version()
    record = maps.record(name, version)
    with as_internal_error(f"{name}@{record.id} cannot be read"):
        return maps.load(name, record.id), f"{name}@{record.id}"
