"""Versions of a live map in the map registry: publish one, and read the one to begin with.  Blocking."""

from __future__ import annotations

import re
from collections.abc import Callable

from rse_pf.errors import Conflict, NotFound
from rse_pf.live_map.versions import errors_of_maps
from rse_pf.maps.format import MapVersion, encode_map
from rse_pf.maps.registry import MapOrigin, MapRecord, MapRegistry
from rse_pf.object_store import digest_of

__all__ = ["publish_version", "version_to_start_from"]

_TRIES = 5
_VERSION = re.compile(r"head|[0-9a-f]{6,64}")


def publish_version(
    maps: MapRegistry, name: str, version: MapVersion, *, author: str, created_s: float, note: str,
    charge: Callable[[int], None],
) -> MapRecord:  # fmt: skip
    """Make *version* the head of map *name* and return its record; the head itself if it is the same map.

    Raises:
        QuotaExceeded, StoreFull: What *charge* raises for the bytes that the version adds to the store.
        Conflict: Others move the head all the time.
        InternalError: The registry takes no such map.
        StoreError: The store fails.
    """
    with errors_of_maps("the live map cannot be published"):
        return _publish(
            maps, name, version, author=author, created_s=created_s, note=note, charge=charge
        )  # fmt: skip


def _publish(
    maps: MapRegistry, name: str, version: MapVersion, *, author: str, created_s: float, note: str,
    charge: Callable[[int], None],
) -> MapRecord:  # fmt: skip
    data = encode_map(version)
    digest = digest_of(data)
    for tries_left in reversed(range(_TRIES)):
        try:
            head: MapRecord | None = maps.head(name)
        except NotFound:
            head = None
        if head is not None and head.digest == digest:
            return head
        parent = None if head is None else head.id
        try:
            origin = MapOrigin(parent=parent, author=author, created_s=created_s, note=note)
            return maps.commit_charged(name, data, origin, charge=charge)
        except Conflict:
            if not tries_left:
                raise
    raise AssertionError("the last try returns or raises")


def version_to_start_from(maps: MapRegistry, map_name: str, source: str) -> tuple[MapVersion, str]:
    """Return the version that *source* names, and its full name ``MAP@ID``.

    Args:
        maps: Of the tenant.
        map_name: Of the live map.
        source: ``MAP@VERSION``, a version of the map *map_name*, or another map, whose head is meant; "" is
            the head of *map_name*.

    Raises:
        InternalError: The version is damaged.
        NotFound: There is no such map or version.
    """
    name, at, version = source.partition("@")
    if not at:
        name, version = (map_name, source or "head") if _is_version(source) else (source, "head")
    record = maps.record(name, version)
    with errors_of_maps(f"{name}@{record.id} cannot be read"):
        return maps.load(name, record.id), f"{name}@{record.id}"


def _is_version(source: str) -> bool:
    return not source or _VERSION.fullmatch(source) is not None
