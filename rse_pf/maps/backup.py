"""Back up all maps of a tenant in one file, check such a file, and restore maps from it.

The file is a tar archive with the members ``MAP/blobs/DIGEST`` (encoded maps) and ``MAP/versions/ID``
(records), whose bytes are those of the store.  Its last member is ``backup.json`` (`BackupContent`): a file
without it was truncated and is refused.  Robots may commit while a backup is written.  The backup may then
lack the versions that were committed meanwhile, but it has the record and the bytes of each version that it
names.  A restore checks the whole file before it writes anything.
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
from rse_pf.identity import name_segment
from rse_pf.maps.record import MapRecord
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import MIN_CHARGE_BYTES, ObjectStore, charge_of

__all__ = ["BackupContent", "CheckedBackup", "check_backup", "restore_backup", "write_backup"]

_CONTENT_FILE = "backup.json"
"""Name of the last member in the tar archive of a backup: a `BackupContent` as JSON."""
_MEMBER = re.compile(r"(?P<map>[a-z0-9][a-z0-9-]{0,63})/(?P<kind>blobs|versions)/(?P<id>[0-9a-f]{64})")
"""Name of a member that holds an encoded map or a record: map, kind, and sha256."""
_CHARGE = re.compile(
    r"[A-Za-z0-9][A-Za-z0-9._=-]{0,127}/(?P<map>[a-z0-9-]{1,64})/(?P<id>[0-9a-f]{64})\.\d{1,15}"
)
"""Name of a charge (see `rse_pf.storage.quotas`) without ``charges/TENANT/``: robot, map, id of the version
and size in bytes."""
_MAX_RECORD_BYTES = 1 << 20
"""Largest size in bytes of the record of one version in a backup file: 1 MiB, though a record with many
robots has some KiB only.  A file with a larger record is refused as malformed."""
_MAX_CONTENT_BYTES = 256 << 20
"""Largest size in bytes of the member `_CONTENT_FILE` of a backup file: 256 MiB, enough for the heads of
10,000 maps and 900,000 charges of versions, each of at most 277 bytes.  A file with a larger member is
refused as malformed."""
_CHUNK_BYTES = 1 << 20  # bytes of an archive's member that are read at once: 1 MiB


class BackupContent(msgspec.Struct, frozen=True, kw_only=True):
    """What a backup contains, the last member of its file.

    Attributes:
        format: Always ``rse-pf-maps``, by which a backup is distinguished from other JSON.
        version: Version of the file format; always 1.
        tenant: The tenant whose maps these are.
        created_s: When the backup was written, Unix seconds.
        heads: The id of the head of each map, by the name of the map.
        charges: The charges of the versions: names of objects below ``charges/TENANT/``, see
            `rse_pf.storage.quotas`.
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
    """Write all maps of a tenant to *file*, and return what the backup contains.

    Args:
        file: A writable binary file.
        maps: The maps of the tenant.
        store: The store of the maps, for their charges.
        tenant: The tenant.
        created_s: Unix seconds.

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
        _add_member(archive, _CONTENT_FILE, msgspec.json.encode(content))
    return content


def _write_map(archive: tarfile.TarFile, maps: MapRegistry, name: str) -> tuple[str, set[str]]:
    """Write the map *name* to *archive*; return the ids of its head and of all versions that were written."""
    # 1. Write the version that is the head now before all others, so that the backup has it even if another
    #    process removes it while the others are written.
    head, data = _read_head(maps, name)
    _add_member(archive, f"{name}/blobs/{head.digest}", data)
    _add_record(archive, name, head)
    digests, ids = {head.digest}, {head.id}
    # 2. Write the other versions; bytes that several versions share are written only once.
    for record in _list_versions(maps, name):
        if record.id == head.id:
            continue
        if record.digest not in digests:
            try:
                data = maps.data(name, record.id)
            except NotFound:  # Leave out a version that another process has removed meanwhile.
                continue
            _add_member(archive, f"{name}/blobs/{record.digest}", data)
        digests.add(record.digest)
        ids.add(record.id)
        _add_record(archive, name, record)
    return head.id, ids


def _list_versions(maps: MapRegistry, name: str) -> list[MapRecord]:
    """Return the records of a map's versions; none if the map has been removed meanwhile."""
    try:
        return maps.versions(name)
    except NotFound:
        return []


def _read_head(maps: MapRegistry, name: str) -> tuple[MapRecord, bytes]:
    """Return record and bytes of the head.

    If another process moves the head and removes the old version between both reads, the new head is read.
    """
    while True:
        head = maps.head(name)
        try:
            return head, maps.data(name, head.id)
        except NotFound:
            if maps.head(name).id == head.id:
                raise


def _add_record(archive: tarfile.TarFile, name: str, record: MapRecord) -> None:
    _add_member(archive, f"{name}/versions/{record.id}", msgspec.json.encode(record))


def _add_member(archive: tarfile.TarFile, name: str, data: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.mode = len(data), 0o600
    archive.addfile(member, io.BytesIO(data))


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckedBackup:
    """A backup whose file is complete and whose hashes are right.

    Attributes:
        content: What the backup contains.
        records: The records of the versions of each map, by the name of the map.
        archive: The open tar archive.
        blobs: The members with encoded maps, by the name of the map and the sha256 of the bytes.
    """

    content: BackupContent
    records: dict[str, list[MapRecord]]
    archive: tarfile.TarFile
    blobs: dict[tuple[str, str], tarfile.TarInfo]

    def data(self, name: str, record: MapRecord) -> bytes:
        """Return the encoded map of the version with this *record* of map *name*."""
        return b"".join(_read_chunks(self.archive, self.blobs[name, record.digest]))


def check_backup(file: BinaryIO) -> CheckedBackup:
    """Read and check all of *file*, and return the backup.

    *file* must stay open as long as the backup is used, because `CheckedBackup.data` reads maps from it.

    Raises:
        UsageError: The file is no backup, is truncated, or was changed.
    """
    try:
        return _read_backup(file)
    except (tarfile.TarError, msgspec.MsgspecError, ValueError, EOFError, OverflowError) as error:
        raise UsageError(
            f"this is not a whole backup of maps: {str(error)[:150]}",
            hint="use another copy of this file, or make a new backup: rse-pf map backup",
        ) from error


def _read_backup(file: BinaryIO) -> CheckedBackup:
    """Return the backup of *file*; raises ValueError and errors of tarfile and msgspec if it is malformed."""
    # Leave the archive open: `CheckedBackup.data` reads maps from it until the caller closes *file*.
    archive = tarfile.open(fileobj=file, mode="r:")  # noqa: SIM115
    records: dict[str, list[MapRecord]] = {}
    blobs: dict[tuple[str, str], tarfile.TarInfo] = {}
    content = None
    for member in archive:
        match = _MEMBER.fullmatch(member.name)
        if member.type != tarfile.REGTYPE or (match is None and member.name != _CONTENT_FILE):
            raise ValueError(f"the member {member.name[:80]!r} does not belong into a backup")
        if match is None:
            content = msgspec.json.decode(
                _read_member(archive, member, _MAX_CONTENT_BYTES), type=BackupContent
            )
        elif match["kind"] == "blobs":
            hashed = hashlib.sha256()
            for chunk in _read_chunks(archive, member):
                hashed.update(chunk)
            if hashed.hexdigest() != match["id"]:
                raise ValueError(f"the bytes of {member.name} have another sha256 than its name says")
            blobs[match["map"], match["id"]] = member
        else:
            record = msgspec.json.decode(_read_member(archive, member, _MAX_RECORD_BYTES), type=MapRecord)
            if record.id != match["id"]:
                raise ValueError(f"the bytes of {member.name} have another sha256 than its name says")
            records.setdefault(match["map"], []).append(record)
    if content is None:
        raise ValueError(f"its last member, {_CONTENT_FILE}, is missing")
    _check_references(content, records, blobs)
    return CheckedBackup(content=content, records=records, archive=archive, blobs=blobs)


def _check_references(
    content: BackupContent,
    records: dict[str, list[MapRecord]],
    blobs: dict[tuple[str, str], tarfile.TarInfo],
) -> None:
    """Raise ValueError if a head, a charge or a version refers to something that is not in the backup."""
    ids = {(name, record.id) for name, versions in records.items() for record in versions}
    for name, versions in records.items():
        for record in versions:
            blob = blobs.get((name, record.digest))
            if blob is None or blob.size != record.size:
                raise ValueError(f"the bytes of version {record.id[:12]} of {name} are missing")
    if records.keys() != content.heads.keys() or not content.heads.items() <= ids:
        raise ValueError("the version that is the head of a map is missing")
    for charge in content.charges:
        match = _CHARGE.fullmatch(charge)
        if match is None or (match["map"], match["id"]) not in ids:
            raise ValueError(f"{charge[:80]!r} is no charge of a version in the backup")


def restore_backup(
    backup: CheckedBackup,
    maps: MapRegistry,
    store: ObjectStore,
    *,
    is_overwriting: bool,
    check_room: Callable[[int], None],
    charge: Callable[[int], None],
) -> int:
    """Write the versions of a backup that the store lacks, and set the heads of its maps.

    A version that is damaged in the store counts as one that the store lacks.  The charges of all versions in
    the backup are written.

    Args:
        backup: The backup.
        maps: The maps of the tenant of the backup.
        store: The store of the maps, for their charges.
        is_overwriting: Whether to set the heads of maps that have another head in the store.  Versions in the
            store that the backup lacks stay.
        check_room: Called once, before anything is written, with the bytes that all versions to write will be
            charged with; an exception that it raises ends the restore.  Not called if the store lacks no
            version.
        charge: Called with the size of each version before it is written; an exception that it raises ends
            the restore.

    Returns:
        The number of versions that were written.

    Raises:
        UsageError: Maps exist with other heads, and *is_overwriting* is false; nothing was written.
        StoreError: The store failed; the same call continues the restore.
    """
    content, heads = backup.content, maps.heads()
    # 1. Check that no head is overwritten by mistake.
    different = [name for name, head in content.heads.items() if heads.get(name, head) != head]
    if different and not is_overwriting:
        raise UsageError(
            f"maps exist and have another head: {', '.join(different)}"[:300],
            hint="--overwrite sets their heads to those of the backup; their other versions stay",
        )
    # 2. Check by *check_room* whether the quota allows all versions that the store lacks.
    missing = {name: maps.missing_versions(name, records) for name, records in backup.records.items()}
    added = [record for records in missing.values() for record in records]
    if added:
        check_room(sum(charge_of(record.size) + MIN_CHARGE_BYTES for record in added))
    # 3. Write the versions, the heads and the charges.
    for name, head in content.heads.items():
        maps.restore(
            name,
            missing[name],
            head,
            expected=heads.get(name),
            charge=charge,
            read=functools.partial(backup.data, name),
        )
    for charge_path in content.charges:
        store.put(f"charges/{name_segment(content.tenant)}/{charge_path}", b"")
    return len(added)


def _read_chunks(archive: tarfile.TarFile, member: tarfile.TarInfo) -> Iterator[bytes]:
    file = archive.extractfile(member)
    while file is not None and (chunk := file.read(_CHUNK_BYTES)):
        yield chunk


def _read_member(archive: tarfile.TarFile, member: tarfile.TarInfo, max_bytes: int) -> bytes:
    if member.size > max_bytes:
        raise ValueError(f"{member.name} has {member.size} bytes, more than {max_bytes}")
    return b"".join(_read_chunks(archive, member))
