"""Move what a robot has stored under an earlier identity to its present one, as an operator requests.

The data of a robot is stored under its name and the id of its key.  After a robot gets its first key, or a
new one, its earlier data is therefore under another identity: its name alone, or its name with the old key.
A server never decides by itself that two identities are one robot.
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

# Location of a store in the memory of a process, which this command cannot read.
_PRIVATE_STORE = "memory:"
# A key's thumbprint (RFC 7638): SHA-256 in base64url, without padding.
_THUMBPRINT = re.compile(r"[A-Za-z0-9_-]{43}")
# An object is copied in pieces of this size, in bytes, so that a large one does not fill the memory.
_PIECE_BYTES = 1 << 20


@dataclass(frozen=True, kw_only=True)
class AdoptRequest(RobotRequest):
    """The options that name a robot, the earlier identity whose data it gets, and the store of the data."""

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
    """What was moved: the number of objects, their bytes, and the number of snapshots of services.

    ``kept`` names the services whose snapshot was not moved, since the robot has another one already.
    """

    objects: int
    object_bytes: int
    snapshots: int
    kept: tuple[str, ...]


def run_adopt(request: AdoptRequest, tenant: str, settings: PlatformSettings, roster: Roster) -> Adopted:
    """Do ``rse-pf robot adopt``, print what was moved, and return it.

    Args:
        request: The robot's name, its earlier key and the store.
        tenant: Tenant of the robot.
        settings: Group data, for the store.
        roster: The enrolled robots.  If a robot of this name is enrolled, the data is moved to the identity
            with its present key, else to the identity of the name alone.

    Raises:
        UsageError: The earlier key is no key id, or the store is in the memory of another process.
        StoreError: The store failed; the same command, given again, moves the rest.
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
    """Return the thumbprint in the key id *key_id*, "" for ""; raises UsageError if it is no key id."""
    thumbprint = key_id.removeprefix(ROBOT_KEY)
    if key_id and not _THUMBPRINT.fullmatch(thumbprint):
        raise UsageError(
            f"{key_id[:80]!r} is not the id of a robot's key",
            hint="rse-pf audit show names the keys of earlier enrolments",
        )
    return thumbprint


def _open_store(request: AdoptRequest, settings: PlatformSettings) -> ObjectStore:
    """Return the store of --store, else of the local platform, else of the settings; raises UsageError."""
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
    """Move objects, charges and snapshots of services that are stored for *source* to *robot*.

    Each is copied and then deleted, so that a second call moves what an interrupted one has left.  Where
    *robot* has another snapshot of a service already, both snapshots stay where they are.

    Args:
        store: Store of the platform.
        robot: The identity that gets the data.
        source: The identity under which the data is stored.

    Raises:
        StoreError: The store failed; a part of the data may have been moved.
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
    """Yield the content of the object *name*, of *size* bytes, in pieces of `_PIECE_BYTES`."""
    for start in range(0, size, _PIECE_BYTES):
        yield store.get_range(name, start, _PIECE_BYTES)


def _is_equal(store: ObjectStore, name: str, other: str) -> bool:
    """Return whether the objects *name* and *other* have the same content; False if one is missing."""
    with contextlib.suppress(NotFound):
        return store.get(name) == store.get(other)
    return False
