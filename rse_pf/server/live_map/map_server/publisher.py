"""Publish versions of a live map to the registry of maps, and remove old ones that nobody asked for.

Two versions of one map server are at least ``live.publish_pause_s`` apart, except for one that is published
when the map is given up.  A new map server does not know whether its predecessor published the newest state:
the first time that a version is due, it publishes also an unchanged map, and the registry keeps equal
versions only once.  The head of a map in the registry is its current version.
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
    LimitExceeded,
    NotFound,
    RsePfError,
)
from rse_pf.live_map.versions import PointSource, as_internal_error
from rse_pf.maps.format import UP_FIELD, MapVersion, encode_map
from rse_pf.maps.registry import MapRecord, MapRegistry
from rse_pf.maps.removal import choose_superseded
from rse_pf.server.live_map.map_server.environment import MapServerEnvironment, Urgency
from rse_pf.server.live_map.map_server.state import MapState
from rse_pf.storage.object_store import digest_of
from rse_pf.wire.live_map import LiveStart

__all__ = ["NOTE_ALL_LEFT", "NOTE_CHANGED", "NOTE_UNUSED", "Publisher", "read_start_version"]

NOTE_ALL_LEFT = "the last robot left"
"""Note of a version that is published because all robots have left the live map."""
NOTE_CHANGED = "live map"
"""Note of a version that a map server publishes by itself: every 10 minutes, if the map has changed since the
last version."""
NOTE_UNUSED = "nobody used the live map"
"""Note of a version that is published because the live map is not used and is given up."""
_AUTOMATIC_NOTES = (NOTE_ALL_LEFT, NOTE_CHANGED, NOTE_UNUSED)
"""Notes of versions that nobody asked for, which may be removed automatically."""
_AUTHOR_PREFIX = "live map on "
"""Beginning of the author of each version of a live map; the id of the backend server follows."""
_QUOTA_DIVISOR = 4
"""The automatic versions of one map take at most the tenant's storage quota divided by this number, but the
newest one stays in any case."""
_MAX_REMOVED_AT_ONCE = 10
"""Largest number of old versions that are removed after a publication, so that the publication ends soon,
also when the server drains; the next publication removes further ones."""
_MAX_WAIT_S = 10.0
"""Longest time in seconds for which a request for a version waits until ``live.publish_pause_s`` has passed;
a request that would wait longer is refused with Busy."""
_RETRY_S = 30.0
"""Seconds after which a failed automatic publication is tried again: each try of a large map takes seconds of
CPU time."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Request:
    """A request for a version with a note; requests are compared by identity, not by their notes."""

    note: str


class Publisher:
    """Publishes versions of one live map; all methods are called in the event loop."""

    def __init__(self, state: MapState, environment: MapServerEnvironment, *, server: str) -> None:
        """Publish nothing yet.

        Args:
            state: The map.
            environment: Environment of its map server; its account is charged before a version is written.
            server: Id of the backend server, which versions name in their author.
        """
        self._state = state
        self._environment = environment
        self._author = _AUTHOR_PREFIX + server
        self._threads = environment.threads
        self._clock = environment.clock
        self._map_name = environment.map_name
        self._min_interval_s = environment.settings.publish_pause_s
        self._lock = asyncio.Lock()  # held during a publication
        # Name of the version that the map started from, and the up direction in that version.
        self._source_up: tuple[str, list[float] | None] = "", None
        self._published_changes: int | None = None  # MapState.changes at the last publication
        self._last_record: MapRecord | None = None
        self._next_allowed_s = float("-inf")  # end of the pause after the last version
        self._due_request: _Request | None = None  # the last request, until a version is published after it
        self._retry_at_s = float("-inf")  # until then, publish_due does nothing

    async def publish(self, note: str, freed_bytes: int = 0) -> MapRecord:
        """Publish the map and return the record of the version.

        If the map has not changed since this object published it, the record of that version is returned.

        Args:
            note: Reason, which is stored with the version.
            freed_bytes: Bytes of the map's log that are deleted after the version is written, and therefore
                do not count for the quota.

        Raises:
            QuotaExceeded, StoreFull: The version does not fit into the storage of the tenant.
            Busy: The version would have to wait for more than 10 s until ``live.publish_pause_s`` has passed;
                ``retry_after_ms`` says when to ask again.
            NotFound: The map has no keyframes.
            Conflict, InternalError, StoreError: The version could not be committed; see `_commit_version`.
        """
        async with self._lock:
            if not self._state.keyframes:
                raise NotFound(
                    f"the live map {self._map_name!r} has no keyframes", hint="drive a robot in it first"
                )
            if self._last_record is not None and not self._is_changed:
                return self._last_record
            wait_s = self._next_allowed_s - self._clock()
            if wait_s > _MAX_WAIT_S:
                raise Busy(
                    f"the live map {self._map_name!r} was published less than "
                    f"{self._min_interval_s:.0f} s ago",
                    hint=f"ask again in {wait_s:.0f} s, or lower live.publish_pause_s",
                    retry_after_ms=1e3 * wait_s,
                )
            if wait_s > 0:
                await self._environment.sleep(wait_s)
            return await self._publish(note, freed_bytes)

    def request(self, note: str) -> None:
        """Make a version with this *note* due until it is published; do nothing if the map is unchanged."""
        if self._is_changed:
            self._due_request = _Request(note)

    async def publish_due(self) -> None:
        """Publish the due version if ``live.publish_pause_s`` has passed since the last version.

        Do nothing if no version is due (see `request`), a publication is under way, or one has failed less
        than 30 s ago.
        """
        if not self._lock.locked() and self._clock() >= max(self._next_allowed_s, self._retry_at_s):
            await self.publish_now()

    async def publish_now(self) -> None:
        """Publish the due version, if there is one, although ``live.publish_pause_s`` may not have passed.

        An error is logged, and the version stays due.
        """
        try:
            async with self._lock:
                if self._due_request is not None and self._is_changed:
                    await self._publish(self._due_request.note)
        except RsePfError as error:
            self._environment.log.warning("live-publish-failed", map=self._map_name, error=error.message)
            self._retry_at_s = self._clock() + _RETRY_S

    @property
    def _is_changed(self) -> bool:
        """Whether the map has keyframes, and differs from the last version of this object or has none yet."""
        return self._state.keyframes > 0 and self._state.changes != self._published_changes

    async def _publish(self, note: str, freed_bytes: int = 0) -> MapRecord:
        environment, background = self._environment, self._threads.background
        changes, due_request = self._state.changes, self._due_request
        # 1. Make the version: keyframes, point cloud, and the up direction.
        version = await self._make_version()
        version = await background(functools.partial(self._add_source_up, version))
        # 2. Charge the tenant, and make the version the head of the map.
        charge = functools.partial(environment.account.reserve, freed=freed_bytes)
        record = await background(functools.partial(self._commit_version, version, note, charge))
        self._next_allowed_s = self._clock() + self._min_interval_s
        self._published_changes, self._last_record = changes, record
        if self._due_request is due_request:  # else the map was requested again after the version was made
            self._due_request = None
        environment.log.info("live-map-published", map=self._map_name, id=record.id, number=record.number)
        # 3. Remove old automatic versions.
        try:
            removed = await background(self._remove_old_versions)
        except RsePfError as error:  # the next publication removes the old versions
            environment.log.warning("live-versions-not-removed", map=self._map_name, error=error.message)
        else:
            if removed:
                environment.log.info("live-versions-removed", map=self._map_name, removed=removed)
        return record

    async def _make_version(self) -> MapVersion:
        """Return the map as a version, with its point cloud if keyframes have stored points.

        Stored objects of forgotten robots are deleted before the points are read.  If a robot is forgotten
        while points are read, the version is made again without its contributions.
        """
        compute, live_map = self._threads.compute, self._state.live_map
        environment, objects = self._environment, self._environment.objects

        def make() -> tuple[MapVersion, tuple[PointSource, ...], list[tuple[str, str]]]:
            version = live_map.to_version()
            if environment.settings.images:
                provenance = {**version.provenance, **live_map.image_references(version)}
                version = dataclasses.replace(version, provenance=provenance)
            return version, live_map.point_sources(version), live_map.deletable_objects

        while True:
            version, sources, forgotten = await compute(Urgency.BACKGROUND, make)
            await self._threads.background(functools.partial(objects.delete_of_forgotten, forgotten))
            if not sources:
                return version
            cloud = await self._threads.background(functools.partial(objects.build_cloud, sources))
            if await compute(Urgency.BACKGROUND, lambda: live_map.deletable_objects) == forgotten:
                break
        environment.log.info(
            "live-cloud",
            map=self._map_name,
            points=len(cloud.points),
            keyframes=cloud.keyframes,
            missing=cloud.missing,
        )
        return dataclasses.replace(version, points=cloud.points, colours=cloud.colours)

    def _add_source_up(self, version: MapVersion) -> MapVersion:
        """Return *version* with the up direction of the version that the map started from.

        The map keeps the axes of that version.  Blocks on the object store.  *version* itself is returned if
        the map started from none, or from one that was removed, is not valid or has no up direction.

        Raises:
            StoreError: The store fails.
        """
        source = str(version.provenance.get("from", ""))
        if self._source_up[0] != source:
            up = None
            with contextlib.suppress(NotFound, BadRequest, BadMessage, LimitExceeded):
                name, _, number = source.partition("@")
                up = self._environment.maps.load(name, number).up
            self._source_up = source, None if up is None else up.tolist()
        if self._source_up[1] is None:
            return version
        return dataclasses.replace(version, provenance={**version.provenance, UP_FIELD: self._source_up[1]})

    def _commit_version(self, version: MapVersion, note: str, charge: Callable[[int], None]) -> MapRecord:
        """Make *version* the head of the map in the registry; if the head has equal bytes, return its record.

        Blocks on the object store.  The contents of the head before are not merged into *version*.

        Raises:
            QuotaExceeded, StoreFull: *charge* refuses the bytes that the version adds to the store.
            Conflict: Another process moved the head meanwhile.
            InternalError: The registry refuses the version as invalid.
            StoreError: The store fails.
        """
        maps, head = self._environment.maps, None
        with as_internal_error("the live map cannot be published"):
            data = encode_map(version)
            with contextlib.suppress(NotFound):
                head = maps.head(self._map_name)
            if head is not None and head.digest == digest_of(data):
                return head
            return maps.commit(
                self._map_name,
                data,
                parent=None if head is None else head.id,
                author=self._author,
                created_s=self._environment.wall_clock(),
                note=note,
                charge=charge,
            )

    def _remove_old_versions(self) -> int:
        """Remove the oldest automatic versions, at most ten, and return their number; blocks on the store.

        The newest ``live.keep_versions`` of them stay (0: all), as far as they fit into a quarter of the
        tenant's quota.  The newest one and the head of the map stay in any case, and so do versions that have
        the same bytes as a version that stays.

        Raises:
            Busy, StoreError: The removal is not complete; the next publication continues it.
        """
        keep, account = self._environment.settings.keep_versions, self._environment.account
        if not keep:
            return 0
        max_bytes = account.quota_bytes() / _QUOTA_DIVISOR

        def choose(records: Sequence[MapRecord], head: str) -> list[MapRecord]:
            old = choose_superseded(records, head, keep=keep, max_bytes=max_bytes, is_counted=_is_automatic)
            return old[:_MAX_REMOVED_AT_ONCE]

        removed = self._environment.maps.remove(self._map_name, choose)
        for record in removed:
            account.release(record.size)
        return len(removed)


def _is_automatic(record: MapRecord) -> bool:
    """Return whether a live map published this version by itself, which its author and note show."""
    return record.author.startswith(_AUTHOR_PREFIX) and record.note in _AUTOMATIC_NOTES


def read_start_version(maps: MapRegistry, request: LiveStart) -> tuple[MapVersion, str]:
    """Read the version from which a live map starts; return it with its full name ``MAP@ID``.

    Blocks on the object store.

    Raises:
        InternalError: The version is no valid map, or larger than the limits.
        NotFound: The registry has no such map or version.
        StoreError: The store fails, or the stored bytes are damaged.
    """
    name, version = request.source_version()
    record = maps.record(name, version)
    with as_internal_error(f"{name}@{record.id} cannot be read"):
        return maps.load(name, record.id), f"{name}@{record.id}"
