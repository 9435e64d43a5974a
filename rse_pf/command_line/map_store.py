"""Options that name the store of maps, the search for that store, and the commit of a drive's map to it.

If no option names a store, it is that of the setting ``data.store``; if that is ``memory:``, it is that of
the platform that runs on this machine, else that of the platform ``default``, which ``rse-pf local`` starts.
"""

from __future__ import annotations

import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.audit.operator import record_map_change
from rse_pf.aws.storage import open_data_store
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError, NotFound, RsePfError, UsageError
from rse_pf.identity import RobotId
from rse_pf.local.processes import is_alive
from rse_pf.local.state import platform_settings, read_state, state_folder
from rse_pf.maps.registry import MapRecord, MapRegistry
from rse_pf.storage.quotas import TenantAccount
from rse_pf.terminal import show, show_json

__all__ = [
    "KeepRequest",
    "MapRequest",
    "StoreRequest",
    "VersionRequest",
    "drive_store",
    "keep_map",
    "map_name",
    "open_maps",
    "with_store",
]

# Location of a store in the memory of a process, which no other process can read.
_IN_MEMORY = "memory:"
# Prefix of the location of a store that is a folder.
_FOLDER = "dir:"
# Folder in a platform's state folder that is the store of a platform with the setting ``memory:``.
_OBJECTS = "objects"
# A valid name of a map.
_MAP_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
# Characters of a folder's name that a map's name may not have; each run of them becomes a hyphen.
_NO_NAME = re.compile(r"[^a-z0-9]+")


@dataclass(frozen=True, kw_only=True)
class StoreRequest:
    """Options of a command on maps: the store, the tenant whose maps they are, and the form of the output."""

    store: str | None = option(
        "--store",
        help="store of the maps: dir:PATH or s3:BUCKET (default: data.store, or that of rse-pf local)",
    )
    platform: str | None = option(
        "--name",
        metavar="PLATFORM",
        help="platform of this machine whose maps are used (default: the one that runs here)",
    )
    tenant: str = option(
        "--tenant", default="default", help="tenant that owns the maps (default: %(default)s)"
    )
    json: bool = option("--json", help="print JSON")

    def settings_with_store(self, settings: PlatformSettings) -> PlatformSettings:
        """Return *settings* with ``data.store`` of the request; raises UsageError if there is none."""
        if self.store is not None and self.platform is not None:
            raise UsageError("--store and --name name two stores", hint="leave one of them out")
        return with_store(self.store, settings, self.platform)

    def open_maps(self, settings: PlatformSettings) -> MapRegistry:
        """Return the maps of the tenant in the store of the request; raises UsageError if there is none."""
        return open_maps(self.settings_with_store(settings), self.tenant)

    def print(self, value: Any, *lines: str) -> None:
        """Print *value* as JSON with ``--json``, else *lines*."""
        if self.json:
            show_json(value, indent=2, sort_keys=True)
        else:
            show(*lines)


@dataclass(frozen=True, kw_only=True)
class MapRequest(StoreRequest):
    """The options of a command on one map: its name, and those of the store."""

    name: str = option(metavar="MAP", help="name of the map")


@dataclass(frozen=True, kw_only=True)
class VersionRequest(MapRequest):
    """The options of a command on one version of a map; ``head`` is the newest one, or that of a rollback."""

    version: str = option(nargs="?", default="head", metavar="VERSION", help="default: %(default)s")


@dataclass(frozen=True, kw_only=True)
class KeepRequest:
    """The options that say in which store, and as which map, the map of a drive is kept."""

    objects: Path | None = option(
        "--objects",
        metavar="DIR",
        help="folder of objects that keeps the map (default: that of data.store, or of rse-pf local)",
    )
    map: str | None = option(
        "--map", metavar="NAME", help="name of the map that is kept (default: the name of --out)"
    )
    tenant: str = option(
        "--tenant", default="default", help="tenant that owns the map (default: %(default)s)"
    )


def with_store(named: str | None, settings: PlatformSettings, name: str | None = None) -> PlatformSettings:
    """Return *settings* with the ``data.store`` that is to be used.

    Without *named* and *name* it is that of *settings*, or, if that is ``memory:``, the store of the platform
    that runs on this machine, else of the platform ``default``.  With the store of a platform,
    ``data.tenant_quota_bytes`` is that of the platform, too.

    Args:
        named: Location of a store, such as ``dir:PATH``; None if no option names one.
        settings: Settings of the command.
        name: Name of a platform on this machine whose store is used; None if no option names one.

    Raises:
        UsageError: The folder of the store, or the platform *name*, does not exist; several platforms run and
            none is named; or no store is named and none is found.
    """
    chosen = settings if named is None else settings.replace(data={"store": named})
    if named is None and (name is not None or chosen.data.store == _IN_MEMORY):
        folder = _platform_folder(name)
        if name is not None and not folder.is_dir():
            known = ", ".join(sorted(each.name for each in folder.parent.glob("*/"))) or "none"
            raise UsageError(
                f"there is no platform {name!r} on this machine",
                hint=f"start one with rse-pf local; known: {known}",
            )
        if folder.is_dir():
            return _with_store_of(folder, settings)
    if chosen.data.store == _IN_MEMORY:
        own = _platform_folder(None) / _OBJECTS
        raise UsageError(
            "no store is named, and one in memory belongs to another process",
            hint=f"name --store dir:PATH; that of rse-pf local is dir:{own}",
        )
    kind, _, path = chosen.data.store.partition(":")
    # Refused here: a missing folder would otherwise be shown as a store without maps.
    if kind == "dir" and not Path(path).is_dir():
        raise UsageError(
            f"there is no folder {path[:200]}",
            hint="check --store; rse-pf local keeps its maps in the folder objects of its state",
        )
    return chosen


def open_maps(settings: PlatformSettings, tenant: str = "default") -> MapRegistry:
    """Return the maps of *tenant* in ``data.store``; each change is recorded in the platform's audit log."""

    def record(action: str, name: str, version: MapRecord) -> None:
        subject = str(RobotId(tenant, name))  # the same form as in entries of the data service
        record_map_change(settings, action, subject, version=version.id, number=version.number)

    max_bytes = 4 * settings.data.max_object_bytes
    return MapRegistry(open_data_store(settings), tenant, max_bytes=max_bytes, on_change=record)


def head_id(name: str, maps: MapRegistry) -> str | None:
    """Return the id of the head, the current version, of map *name*; None if there is no such map."""
    try:
        return maps.head(name).id
    except NotFound:
        return None


def split_version(word: str) -> tuple[str, str]:
    """Return name and version of *word*, ``MAP`` or ``MAP@VERSION``; without a version, ``head``."""
    name, _, version = word.partition("@")
    return name, version or "head"


def map_name(name: str | None, out: Path) -> str:
    """Return the name of the map of a drive; if *name* is None, made of the name of the folder *out*.

    Raises:
        UsageError: *name* has other characters than small letters, digits and hyphens, or is too long.
    """
    if name is None:
        return _NO_NAME.sub("-", out.absolute().name.lower()).strip("-")[:64].strip("-") or "drive"
    if not _MAP_NAME.fullmatch(name):
        raise UsageError(
            f"{name[:80]!r} is not a valid name of a map",
            hint="use 1 to 64 small letters, digits and hyphens",
        )
    return name


def drive_store(folder: Path | None, settings: PlatformSettings) -> PlatformSettings:
    """Return *settings* with the ``data.store`` that keeps the map of a drive.

    It is *folder*; if that is None, the store of *settings*; if that is ``memory:``, the store of the
    platform that runs on this machine, else of ``rse-pf local``.  A folder that does not exist is created.

    Raises:
        UsageError: The folder cannot be created, or several platforms run and none is named.
    """
    if folder is None and settings.data.store != _IN_MEMORY:
        return settings
    if folder is None:
        settings = _with_store_of(_platform_folder(None), settings)
        if not settings.data.store.startswith(_FOLDER):
            return settings
        folder = Path(settings.data.store.removeprefix(_FOLDER))
    folder = folder.absolute()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot make {folder}: {error.strerror}", hint="name another --objects") from error
    return settings.replace(data={"store": f"{_FOLDER}{folder}"})


def keep_map(
    data: bytes, name: str, settings: PlatformSettings, *, tenant: str, author: str
) -> dict[str, Any]:
    """Commit *data*, an encoded map, as the next version of map *name*; return fields for the report.

    The fields are ``store`` and ``map``, as ``rse-pf map`` takes them, and ``map_version``, the new id.

    Args:
        data: The encoded map.
        name: Name of the map.
        settings: Group data: store and quotas.
        tenant: Tenant that the map belongs to.
        author: The program that made the map, for the record of the version.

    Raises:
        QuotaExceeded: The tenant would store more than its quota.
        RsePfError: The map was not stored.
    """
    maps = open_maps(settings, tenant)
    TenantAccount(open_data_store(settings), tenant, settings.data).reserve(len(data))
    version = maps.commit(
        name, data, parent=head_id(name, maps), author=author, created_s=time.time(), note="a drive"
    )
    return {"store": settings.data.store, "map": name, "map_version": version.id}


def _platform_folder(name: str | None) -> Path:
    """Return the state folder of the platform *name*; it need not exist.

    If *name* is None, that of the platform that runs on this machine, else of the platform ``default``.

    Raises:
        UsageError: *name* is None and several platforms run here.
    """
    own = state_folder(name or "default", os.environ)
    running = []
    for folder in sorted(own.parent.glob("*/")) if name is None else ():
        try:
            state = read_state(folder)
        except RsePfError:
            continue
        if state is not None and is_alive(state.control_plane):
            running.append(folder)
    if len(running) > 1:
        names = ", ".join(folder.name for folder in running)
        raise UsageError(
            f"several platforms run on this machine: {names}", hint="name one by --name, or its store"
        )
    return running[0] if running else own


def _with_store_of(folder: Path, settings: PlatformSettings) -> PlatformSettings:
    """Return *settings* with the store and the tenant quota of the platform whose state is in *folder*.

    If the platform's settings cannot be read, or its store is ``memory:``, its folder ``objects`` is the
    store.
    """
    try:
        known = platform_settings(folder)
    except ConfigurationError:
        known = None
    data = (settings if known is None else known).data
    store = data.store if known is not None and data.store != _IN_MEMORY else f"{_FOLDER}{folder / _OBJECTS}"
    return settings.replace(data={"store": store, "tenant_quota_bytes": data.tenant_quota_bytes})
