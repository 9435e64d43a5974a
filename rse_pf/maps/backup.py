"""Back up all maps of a tenant in one file, and check and restore such a file.

The file is a tar archive.  It holds ``MAP/blobs/DIGEST`` and ``MAP/versions/ID`` with the bytes of the store,
and at its end ``backup.json`` with the heads, so that a file that was cut off is no backup.  Robots may write
meanwhile: versions never change, so each one in the file is whole, and so is the head of each map.  Nothing
is restored before the whole file was checked.
"""

from __future__ import annotations

import functools
import hashlib
import io
import re
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO, Literal

import msgspec

from rse_pf.errors import NotFound, UsageError
from rse_pf.maps.record import MapRecord
from rse_pf.maps.registry import MapRegistry
from rse_pf.object_store import MIN_CHARGE_BYTES, ObjectStore, charge_of, name_segment

__all__ = ["BackupContent", "CheckedBackup", "check_backup", "restore_backup", "write_backup"]

_CONTENT = "backup.json"
_MEMBER = re.compile(r"(?P<map>[a-z0-9][a-z0-9-]{0,63})/(?P<kind>blobs|versions)/(?P<id>[0-9a-f]{64})")
_CHARGE = re.compile(
    r"[A-Za-z0-9][A-Za-z0-9._=-]{0,127}/(?P<map>[a-z0-9-]{1,64})/(?P<id>[0-9a-f]{64})\.\d{1,15}"
)
_MAX_RECORD_BYTES = 1 << 20  # a record names robots; the longest one that is written has some KiB
_MAX_CONTENT_BYTES = 256 << 20  # heads and charges of 10,000 maps with all their versions
_PIECE_BYTES = 1 << 20


class BackupContent(msgspec.Struct, frozen=True, kw_only=True):
    """The last member: whose maps, made when (Unix time), their heads, and who is charged with versions.

    A charge is the name of an object below ``charges/TENANT/``, see `rse_pf.maps.charges`.
    """

    format: Literal["rse-pf-maps"] = "rse-pf-maps"
    version: Literal[1] = 1
    tenant: str
    created_s: float
    heads: dict[str, str]
    charges: list[str] = []


def write_backup(
    file: BinaryIO, maps: MapRegistry, store: ObjectStore, *, tenant: str, created_s: float
) -> BackupContent:
    """Write all versions and heads of the maps of *tenant* to *file*; returns its content.

    Raises:
        StoreError: The store failed, or a version is damaged.
    """
    heads: dict[str, str] = {}
    charges: list[str] = []
    prefix = f"charges/{name_segment(tenant)}/"
    with tarfile.open(fileobj=file, mode="w") as archive:
        for name in maps.names():
            heads[name], versions = _write_map(archive, maps, name)
            for robot in store.folders(prefix):
                charges += [
                    info.name.removeprefix(prefix)
                    for info in store.list(f"{prefix}{robot}/{name}/")
                    if info.name.rpartition("/")[2].partition(".")[0] in versions
                ]
        content = BackupContent(tenant=tenant, created_s=created_s, heads=heads, charges=charges)
        _add(archive, _CONTENT, msgspec.json.encode(content))
    return content


def _write_map(archive: tarfile.TarFile, maps: MapRegistry, name: str) -> tuple[str, set[str]]:
    """Write a map; return the id of its head, and the ids of all versions that were written."""
    head, data = _read_head(maps, name)
    _add(archive, f"{name}/blobs/{head.digest}", data)
    blobs, versions = {head.digest}, {head.id}
    _add_record(archive, name, head)
    for record in _versions(maps, name):
        if record.id == head.id:
            continue
        if record.digest not in blobs:
            try:
                data = maps.data(name, record.id)
            except NotFound:  # it was removed meanwhile
                continue
            _add(archive, f"{name}/blobs/{record.digest}", data)
        blobs.add(record.digest)
        versions.add(record.id)
        _add_record(archive, name, record)
    return head.id, versions


def _versions(maps: MapRegistry, name: str) -> list[MapRecord]:
    """Return the versions of a map; none if all that were listed have been removed while they were read."""
    try:
        return maps.versions(name)
    except NotFound:
        return []


def _read_head(maps: MapRegistry, name: str) -> tuple[MapRecord, bytes]:
    """Return record and bytes of the head, also if others set another head and remove this one meanwhile."""
    while True:
        head = maps.head(name)
        try:
            return head, maps.data(name, head.id)
        except NotFound:
            if maps.head(name).id == head.id:
                raise


def _add_record(archive: tarfile.TarFile, name: str, record: MapRecord) -> None:
    _add(archive, f"{name}/versions/{record.id}", msgspec.json.encode(record))


def _add(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.mode = len(data), 0o600
    archive.addfile(member, io.BytesIO(data))


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckedBackup:
    """A file in which every hash is right: what it holds, the records of each map, where their bytes are."""

    content: BackupContent
    records: dict[str, list[MapRecord]]
    archive: tarfile.TarFile
    blobs: dict[tuple[str, str], tarfile.TarInfo]

    def data(self, name: str, record: MapRecord) -> bytes:
        """Return the bytes of a version of map *name*."""
        return b"".join(_pieces(self.archive, self.blobs[name, record.digest]))


def check_backup(file: BinaryIO) -> CheckedBackup:
    """Read all of *file*, and return what it holds.

    Raises:
        UsageError: It is no backup, or was cut off or changed.
    """
    try:
        return _check(file)
    except (tarfile.TarError, msgspec.MsgspecError, ValueError, EOFError, OverflowError) as error:
        raise UsageError(
            f"this is not a whole backup of maps: {str(error)[:150]}",
            hint="use another copy of it, or write it again: rse-pf map backup",
        ) from error


def _check(file: BinaryIO) -> CheckedBackup:
    archive = tarfile.open(fileobj=file, mode="r:")  # noqa: SIM115  it is read for as long as the file is open
    records: dict[str, list[MapRecord]] = {}
    blobs: dict[tuple[str, str], tarfile.TarInfo] = {}
    content = None
    for member in archive:
        match = _MEMBER.fullmatch(member.name)
        if member.type != tarfile.REGTYPE or (match is None and member.name != _CONTENT):
            raise ValueError(f"{member.name[:80]!r} does not belong into it")
        if match is None:
            content = msgspec.json.decode(_read(archive, member, _MAX_CONTENT_BYTES), type=BackupContent)
        elif match["kind"] == "blobs":
            hashed = hashlib.sha256()
            for piece in _pieces(archive, member):
                hashed.update(piece)
            if hashed.hexdigest() != match["id"]:
                raise ValueError(f"the hash of {member.name} is another one")
            blobs[match["map"], match["id"]] = member
        else:
            record = msgspec.json.decode(_read(archive, member, _MAX_RECORD_BYTES), type=MapRecord)
            if record.id != match["id"]:
                raise ValueError(f"the hash of {member.name} is another one")
            records.setdefault(match["map"], []).append(record)
    if content is None:
        raise ValueError("its end is missing")
    _check_references(content, records, blobs)
    return CheckedBackup(content=content, records=records, archive=archive, blobs=blobs)


def _check_references(
    content: BackupContent,
    records: dict[str, list[MapRecord]],
    blobs: dict[tuple[str, str], tarfile.TarInfo],
) -> None:
    """Raise ValueError if a head, a charge or a version refers to something that the file does not hold."""
    known = {(name, record.id) for name, versions in records.items() for record in versions}
    for name, versions in records.items():
        for record in versions:
            blob = blobs.get((name, record.digest))
            if blob is None or blob.size != record.size:
                raise ValueError(f"the bytes of version {record.id[:12]} of {name} are missing")
    if records.keys() != content.heads.keys() or not content.heads.items() <= known:
        raise ValueError("the head of a map is missing")
    for charge in content.charges:
        match = _CHARGE.fullmatch(charge)
        if match is None or (match["map"], match["id"]) not in known:
            raise ValueError(f"{charge[:80]!r} is no charge of a version in it")


def restore_backup(
    backup: CheckedBackup,
    maps: MapRegistry,
    store: ObjectStore,
    *,
    is_overwriting: bool,
    check_room: Callable[[int], None],
    charge: Callable[[int], None],
) -> int:
    """Write the versions of a backup that are missing, and set the heads; return how many were missing.

    Args:
        backup: The file.
        maps: Of the tenant of the backup.
        store: Where they lie.
        is_overwriting: Whether heads of maps that exist are set back; their other versions stay.
        check_room: Gets for how many bytes all versions count, before anything is written.
        charge: Gets the size of each version before it is written.

    Raises:
        UsageError: Maps exist and have other heads, and *is_overwriting* is false; nothing was written.
        StoreError: The store failed; the same call continues.  And what *check_room* and *charge* raise.
    """
    content, heads = backup.content, maps.heads()
    others = [name for name, head in content.heads.items() if heads.get(name, head) != head]
    if others and not is_overwriting:
        raise UsageError(
            f"maps exist and have another head: {', '.join(others)}"[:300],
            hint="--overwrite sets their heads to those of the backup; their other versions stay",
        )
    missing = {name: maps.missing_versions(name, records) for name, records in backup.records.items()}
    added = [record for records in missing.values() for record in records]
    if added:
        check_room(sum(charge_of(record.size) + MIN_CHARGE_BYTES for record in added))
    for name, head in content.heads.items():
        maps.restore(
            name, missing[name], head, expected=heads.get(name), charge=charge,
            read=functools.partial(backup.data, name),
        )  # fmt: skip
    for each in content.charges:
        store.put(f"charges/{name_segment(content.tenant)}/{each}", b"")
    return len(added)


def _pieces(archive: tarfile.TarFile, member: tarfile.TarInfo) -> Iterator[bytes]:
    file = archive.extractfile(member)
    while file is not None and (piece := file.read(_PIECE_BYTES)):
        yield piece


def _read(archive: tarfile.TarFile, member: tarfile.TarInfo, max_bytes: int) -> bytes:
    if member.size > max_bytes:
        raise ValueError(f"{member.name} is longer than {max_bytes} bytes")
    return b"".join(_pieces(archive, member))
