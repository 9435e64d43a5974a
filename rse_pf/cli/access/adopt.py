"""Give a robot what is stored under an older identity of it, because an operator says that it is the same.

A robot that had no key stored under its name alone, and one that was enrolled with a new key under the old
key.  A server never decides by itself that two identities are one robot.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rse_pf.auth.roster import ROBOT_KEY, Roster
from rse_pf.aws.storage import open_data_store
from rse_pf.cli.access.access_control import RobotRequest, described
from rse_pf.command_line.map_store import with_store
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import Conflict, NotFound, UsageError
from rse_pf.identity import RobotId
from rse_pf.storage.object_store import ObjectStore
from rse_pf.terminal import counted, show

__all__ = ["AdoptRequest", "Adopted", "adopt", "run_adopt"]

_PRIVATE_STORE = "memory:"
_THUMBPRINT = re.compile(r"[A-Za-z0-9_-]{43}")

_PIECE_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class AdoptRequest(RobotRequest):
    """A robot, and the earlier identity whose data it gets."""

    from_key: str = option(
        "--from-key",
        default="",
        metavar="KEY",
        help="id of the robot's earlier key (default: what was stored for the name without a key)",
    )
    store: str | None = option(
        "--store", help="dir:PATH or s3:BUCKET (default: data.store, or the local platform's)"
    )
    not_enrolled: bool = option(
        "--not-enrolled",
        help="the robot has no key of its own, and uses tokens of rse-pf token issue",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Adopted:
    """What was moved: objects, their bytes, snapshots of services, and the services that have a newer one."""

    objects: int
    object_bytes: int
    snapshots: int
    kept: tuple[str, ...]


def run_adopt(request: AdoptRequest, tenant: str, settings: PlatformSettings, roster: Roster) -> Adopted:
    """Do ``rse-pf robot adopt``, print what was moved, and return it.

    Args:
        request: The robot, its earlier key and the store.
        tenant: Of the robot.
        settings: Group data, for the store.
        roster: The robot is who is enrolled there under its name now, or else who has tokens of the platform.

    Raises:
        UsageError: The store belongs to another process.
        StoreError: The store failed in between; the same command continues.
    """
    enrolled = roster.find(tenant, request.robot)
    robot = RobotId(tenant, request.robot) if enrolled is None else enrolled.id
    source = robot._replace(enrolment=_thumbprint(request.from_key))
    adopted = adopt(_open_store(request, settings), robot, source=source)
    show(
        f"{described(robot.name, robot.tenant)} has {counted(adopted.objects, 'object')} more, "
        f"{counted(adopted.object_bytes, 'byte')}, and "
        f"{counted(adopted.snapshots, 'snapshot')} of services"
    )
    for service in adopted.kept:
        show(f"its snapshot of service {service!r} is newer than the one that was to be moved, and stays")
    return adopted


def _thumbprint(key_id: str) -> str:
    thumbprint = key_id.removeprefix(ROBOT_KEY)
    if key_id and not _THUMBPRINT.fullmatch(thumbprint):
        raise UsageError(
            f"{key_id[:80]!r} is not the id of a robot's key",
            hint="rse-pf audit show names removed ones",
        )
    return thumbprint


def _open_store(request: AdoptRequest, settings: PlatformSettings) -> ObjectStore:
    if request.store is None and not request.cloud and request.folder.is_dir():
        settings = with_store(None, settings, request.name)
        kind, _, folder = settings.data.store.partition(":")
        if kind == "dir" and not Path(folder).is_dir():
            raise UsageError(
                f"the platform {request.name!r} of this machine has stored nothing yet",
                hint="so there is nothing to adopt; or name another store: --store dir:PATH",
            )
    location = request.store or settings.data.store
    if location == _PRIVATE_STORE:
        raise UsageError("a store in memory belongs to another process", hint="name --store dir:PATH")
    return open_data_store(settings.replace(data={"store": location}))


def adopt(store: ObjectStore, robot: RobotId, *, source: RobotId) -> Adopted:
    """Move what is stored for *source* to *robot*; after an interruption, the next call continues.

    A snapshot that *robot* has already stays, and the older one is left where it is.

    Args:
        store: Of the platform.
        robot: Who gets it.
        source: Who it was stored for.

    Raises:
        StoreError: The store failed in between.
    """
    objects = object_bytes = snapshots = 0
    kept: list[str] = []
    if source == robot:
        return Adopted(objects=0, object_bytes=0, snapshots=0, kept=())
    for kind in ("objects", "charges"):
        old, new = f"{kind}/{source.folder}/", f"{kind}/{robot.folder}/"
        for info in store.list(old):
            store.put_pieces(new + info.name.removeprefix(old), _pieces(store, info.name, info.size))
            store.delete(info.name)
            objects += kind == "objects"
            object_bytes += info.size
    old, new = f"states/{source.folder}/", f"states/{robot.folder}/"
    for info in list(store.list(old)):
        service = info.name.removeprefix(old)
        try:
            store.compare_and_swap(new + service, None, store.get(info.name))
        except Conflict:
            if _is_equal(store, info.name, new + service):
                store.delete(info.name)
            else:
                kept.append(service)
            continue
        store.delete(info.name)
        snapshots += 1
    return Adopted(objects=objects, object_bytes=object_bytes, snapshots=snapshots, kept=tuple(kept))


def _pieces(store: ObjectStore, name: str, size: int) -> Iterator[bytes]:
    for start in range(0, size, _PIECE_BYTES):
        yield store.get_range(name, start, _PIECE_BYTES)


def _is_equal(store: ObjectStore, name: str, other: str) -> bool:
    with contextlib.suppress(NotFound):
        return store.get(name) == store.get(other)
    return False
