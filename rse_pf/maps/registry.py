"""The registry of maps: versions never change, and the head of a map moves by compare-and-swap.

A commit writes the map, then its record, then the head, and each write is durable before the next one begins.
A crash between two writes leaves the old head and at most an object that nothing refers to.  Every version
that a head refers to is complete, and of two commits with the same parent only one succeeds.  A removed
version is gone with its bytes; a version that shares its bytes with one that stays is not removed.  The id of
a removed version may still be the parent of another version.

Objects in the store: ``maps/TENANT/NAME/blobs/DIGEST`` (encoded maps), ``maps/TENANT/NAME/versions/ID``
(records; the id is the sha256 of the record) and ``maps/TENANT/NAME/head`` (the id of the head).
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from rse_pf.errors import BadRequest, Busy, Conflict, LimitExceeded, NotFound, StoreError
from rse_pf.identity import name_segment
from rse_pf.maps.describe import MapSummary, describe_map
from rse_pf.maps.record import MapRecord
from rse_pf.maps.removal import HELD, MAX_REMOVAL_S, REMOVING, Marks
from rse_pf.storage.object_store import ObjectStore, digest_of
from rse_pf.storage.quotas import remove_charges

if TYPE_CHECKING:  # Importing numpy takes a third of a data server's start, and only decoding a map needs it.
    from rse_pf.maps.format import Keyframe, MapVersion

__all__ = ["MapContent", "MapDiff", "MapOrigin", "MapRecord", "MapRegistry", "compare_versions"]

IMAGES_FIELD = "images"
"""Field of a live map's provenance: the sha256 of the image of each keyframe, by robot and id."""
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
_ID = re.compile(r"[0-9a-f]{64}")
_ROBOT = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=-]*")
_MIN_ID_DIGITS = 6
"""Number of hexadecimal digits from which the beginning of an id is accepted as the name of a version."""
_JPEG_MAGIC = b"\xff\xd8\xff"  # the first bytes of a JPEG file
_MAX_IMAGE_BYTES = 64 << 20
"""Largest size in bytes of the stored image of a keyframe that is read: 64 MiB, since a robot may have
stored any object."""
_MAX_MAPS = 10_000
"""Largest number of maps of one tenant: all of them are read when somebody lists maps."""
_MAX_VERSIONS = 10_000
"""Largest number of versions of one map: all of them are read when somebody lists versions."""
_CHUNK_BYTES = 1 << 20
"""Number of bytes of an object that are in memory at once while a map is committed from it: 1 MiB."""
_REMOVED_AT_ONCE = 50
"""Number of encoded maps that are marked and removed together, each with all its versions: so few that a slow
store removes them before `MAX_REMOVAL_S`, at which a removal stops."""
_MIN_MOTION_M = 1e-3
"""Translation of a keyframe between two versions, in metres, above which the keyframe counts as moved: more
than the rounding of poses in messages."""
_MIN_ROTATION_DEG = 0.05
"""Rotation of a keyframe between two versions, in degrees, above which the keyframe counts as moved: more
than the rounding of poses in messages."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapDiff:
    """The differences between two versions of a map.

    Attributes:
        added: Ids of the keyframes that only the newer version has.
        removed: Ids of the keyframes that only the older version has.
        moved: Ids of the keyframes that moved by more than 1 mm or 0.05 degrees.
        largest_move_m: The largest translation of a keyframe that both versions have; 0 without such ones.
        largest_turn_deg: The largest rotation of a keyframe that both versions have; 0 without such ones.
        edges_added: Edges that only the newer version has, as (id, id, kind).
        edges_removed: Edges that only the older version has, as (id, id, kind).
        points_before: Number of points in the older version.
        points_after: Number of points in the newer version.
    """

    added: tuple[int, ...]
    removed: tuple[int, ...]
    moved: tuple[int, ...]
    largest_move_m: float
    largest_turn_deg: float
    edges_added: tuple[tuple[int, int, str], ...]
    edges_removed: tuple[tuple[int, int, str], ...]
    points_before: int
    points_after: int


class MapContent(NamedTuple):
    """The sha256 (hexadecimal) and the size in bytes of an encoded map."""

    digest: str
    size: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOrigin:
    """Who makes a version, and from which one.

    Attributes:
        parent: Id of the head that the author last read; None if there was no map.
        author: Who makes the version.
        created_s: Unix seconds.
        note: What the author says about it.
    """

    parent: str | None
    author: str
    created_s: float
    note: str = ""


class MapRegistry:
    """The maps of one tenant in one store.  Its methods block.

    A version is named by its id, by six or more digits of the beginning of its id, or by ``head``.
    """

    def __init__(
        self,
        store: ObjectStore,
        tenant: str = "default",
        *,
        max_bytes: int = 1 << 30,
        on_change: Callable[[str, str, MapRecord], None] = lambda action, name, record: None,
        check: Callable[[], None] = lambda: None,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        """Make a registry, and read nothing yet.

        Args:
            store: The store of the maps.
            tenant: The tenant whose maps these are.
            max_bytes: The largest size of a decompressed map.
            on_change: Called after a change with the kind of the change, the name of the map and the record
                of the version.  The kinds are ``map.commit``, ``map.head`` (the head was set to an existing
                version), ``map.remove`` and ``map.restore`` (the head was set from a backup).
            check: Called between two reads in long work; an error that it raises stops the work.
            wall_clock: Returns Unix seconds.
        """
        self._store, self._wall_clock = store, wall_clock
        self._on_change = on_change
        self._tenant = name_segment(tenant)
        self._prefix = f"maps/{self._tenant}/"
        self._max_bytes = max_bytes
        self._check = check

    def names(self) -> list[str]:
        """Return the names of all maps that have a head, sorted."""
        return list(self.heads())

    def heads(self) -> dict[str, str]:
        """Return the ids of the heads of all maps by the names of the maps, sorted by name."""
        heads = {}
        for name in self._store.folders(self._prefix):
            self._check()
            head = self._head(name) if _NAME.fullmatch(name) else None
            if head is not None:
                heads[name] = head
        return heads

    def commit(
        self,
        name: str,
        data: bytes,
        *,
        parent: str | None,
        author: str,
        created_s: float,
        note: str = "",
        charge: Callable[[int], None] = lambda size: None,
    ) -> MapRecord:
        """Make *data* the next version of map *name*, and its head.

        Args:
            name: Name of the map: 1 to 64 lower-case letters, digits and hyphens.
            data: The bytes that `encode_map` returned.
            parent: Id of the head that the caller last read; None for the first version.
            author: Who made the version.
            created_s: Unix seconds.
            note: What the author says about it.
            charge: Called before anything is written, with the size of *data* in bytes, or 0 if another
                version of the map has the same bytes; an exception that it raises refuses the version.

        Raises:
            BadRequest: *data* is not a map, or *name* is not a valid name.
            Conflict: The head is not *parent*: read the head, merge, and commit again.
            LimitExceeded: *data* has too many keyframes, features or edges, the tenant too many maps, or the
                map too many versions.
            Busy: The same bytes are being removed.
            StoreError: The store failed; the head did not change.
        """
        return self._commit(
            name,
            describe_map(data, self._max_bytes),
            MapContent(digest_of(data), len(data)),
            MapOrigin(parent=parent, author=author, created_s=created_s, note=note),
            write=lambda blob: self._store.put(blob, data),
            charged=lambda record, size: _charge_once(charge, size),
        )

    def commit_object(
        self,
        name: str,
        source: str,
        summary: MapSummary,
        content: MapContent,
        origin: MapOrigin,
        charged: Callable[[MapRecord, int], AbstractContextManager[None]],
    ) -> MapRecord:
        """Commit an object of the store as `commit` does, without holding it in memory.

        Args:
            name: Name of the map.
            source: Name of the object that holds the encoded map.
            summary: The summary of the map that `rse_pf.maps.describe.describe_map` returned.
            content: Digest and size of the object.
            origin: Who makes the version, and from which one.
            charged: Called with the record of the version and the size of the bytes that it adds to the
                store, 0 if another version has the same bytes; returns a context manager within which the
                version is written.  An exception that *charged* or the context manager raises on entry
                refuses the version.

        Raises:
            As `commit`, and the errors of *charged*.
        """

        def read_chunks() -> Iterator[bytes]:
            hashed = hashlib.sha256()
            for start in range(0, content.size, _CHUNK_BYTES):
                self._check()
                chunk = self._store.get_range(source, start, _CHUNK_BYTES)
                hashed.update(chunk)
                yield chunk
            if hashed.hexdigest() != content.digest:
                raise StoreError(
                    f"the sha256 of the object {source} is not {content.digest}",
                    hint="store the object again",
                )

        return self._commit(
            name,
            summary,
            content,
            origin,
            write=lambda blob: self._store.put_pieces(blob, read_chunks()),
            charged=charged,
        )

    def _commit(
        self,
        name: str,
        summary: MapSummary,
        content: MapContent,
        origin: MapOrigin,
        *,
        write: Callable[[str], None],
        charged: Callable[[MapRecord, int], AbstractContextManager[None]],
    ) -> MapRecord:
        digest, parent = content.digest, origin.parent
        base = self._base(name)
        # 1. Refuse the commit unless the head is the stated parent, and make the record.
        if self._head(name) != parent:
            raise _head_moved(name)
        parent_record = self.record(name, parent) if parent is not None else None
        self._check_counts(base, is_new=parent_record is None)
        record = MapRecord(
            digest=digest,
            size=content.size,
            parent=None if parent_record is None else parent_record.id,
            number=1 if parent_record is None else parent_record.number + 1,
            author=origin.author,
            created_s=origin.created_s,
            note=origin.note,
            keyframes=summary.keyframes,
            edges=summary.edges,
            points=summary.points,
            robots=summary.robots,
        )
        # 2. Unless a process removes the same bytes, charge and write the map and the record, then move the
        #    head.
        self._marks(name).check(digest)
        is_new = not self._exists(f"{base}blobs/{digest}")
        with charged(record, content.size if is_new else 0):
            self._put_version(name, record, write, is_new=is_new)
            self._swap(name, parent, record.id)
        self._on_change("map.commit", name, record)
        return record

    def _put_version(
        self, name: str, record: MapRecord, write: Callable[[str], None], *, is_new: bool
    ) -> None:
        """Write a record, and the bytes of its version if they are not in the store yet.

        Args:
            name: Name of the map.
            record: The record.
            write: Writes the bytes of the version to the object with the given name.
            is_new: Whether to write the bytes before the record, because the store lacks them or has them
                damaged.  Otherwise they are written only if a removal has deleted them meanwhile.

        Raises:
            Busy: Another process removes these bytes; the record is removed again.
        """
        blob = f"{self._base(name)}blobs/{record.digest}"
        version = f"{self._base(name)}versions/{record.id}"
        if is_new:
            write(blob)
        self._store.put(version, msgspec.json.encode(record))
        try:
            self._marks(name).check(record.digest)
        except Busy:
            self._store.delete(version)
            raise
        # A removal that had read the records before this record was written may have removed the bytes.  That
        # removal has ended, since its mark is gone, and each later removal sees the record: if the bytes are
        # gone, they are written again.
        if not self._exists(blob):
            write(blob)

    def missing_versions(self, name: str, records: Sequence[MapRecord]) -> list[MapRecord]:
        """Return those of *records* whose versions of map *name* are missing or damaged in the store."""
        missing = []
        for record in records:
            self._check()
            try:
                self.data(name, record.id)
            except StoreError:
                missing.append(record)
        return missing

    def restore(
        self,
        name: str,
        records: Sequence[MapRecord],
        head: str,
        *,
        expected: str | None,
        read: Callable[[MapRecord], bytes],
        charge: Callable[[int], None],
    ) -> None:
        """Write versions from a backup, and set the head.

        If *head* is *expected*, the head is neither compared nor changed, and *on_change* is not called.

        Args:
            name: Name of the map, which may exist.
            records: Records of the versions to write; their bytes are written even if the store has them,
                since these may be damaged.
            head: Id of the new head, which is one of *records* or exists.
            expected: Id of the present head; None if there is no map.
            read: Returns the bytes of a version.
            charge: Called with the size of each version before it is written; an exception that it raises
                ends the restore.

        Raises:
            Conflict: The head is not *expected*.
            LimitExceeded: The tenant has too many maps, or the map too many versions.
            Busy: The bytes of a version are being removed.
            StoreError: The store failed; the head did not change.
        """
        self._check_counts(self._base(name), is_new=expected is None)
        for record in records:
            self._marks(name).check(record.digest)
            charge(record.size)
            write = functools.partial(self._store.put, data=read(record))
            self._put_version(name, record, write, is_new=True)
        if expected is None:
            self._swap(name, None, head)
            self._on_change("map.restore", name, self.record(name, head))
        elif expected != head:
            self._move_head(name, self.record(name, head), expected)
            self._on_change("map.restore", name, self.record(name, head))

    def _check_counts(self, base: str, *, is_new: bool) -> None:
        """Raise LimitExceeded if a map has too many versions, or is new and the tenant has too many maps."""
        versions = self._store.usage(f"{base}versions/").objects
        if versions >= _MAX_VERSIONS:
            raise LimitExceeded(
                f"the map has {versions} versions, the limit is {_MAX_VERSIONS}",
                hint="remove old ones: rse-pf map prune",
            )
        maps = sum(1 for _ in self._store.folders(self._prefix)) if is_new else 0
        if maps >= _MAX_MAPS:
            raise LimitExceeded(
                f"the tenant has {maps} maps, the limit is {_MAX_MAPS}", hint="commit to an existing map"
            )

    def _exists(self, name: str) -> bool:
        try:
            self._store.head(name)
        except NotFound:
            return False
        return True

    def head(self, name: str) -> MapRecord:
        """Return the record of the head; raises NotFound if there is no map *name*."""
        head = self._head(name)
        while head is not None:
            try:
                return self.record(name, head)
            except NotFound:
                # Read the head again, since another process may have moved it and removed the old version;
                # if the head is the same, its version is missing.
                missing, head = head, self._head(name)
                if head == missing:
                    raise
        raise NotFound(f"there is no map {name!r}", hint="see rse-pf map list")

    def record(self, name: str, version: str) -> MapRecord:
        """Return the record of a version.

        Args:
            name: Name of the map.
            version: Its id, an unambiguous beginning of its id, or ``head``.

        Raises:
            NotFound: There is no such map or version.
            StoreError: The record is damaged.
        """
        if version == "head":
            return self.head(name)
        prefix = f"{self._base(name)}versions/"
        if not _ID.fullmatch(version):
            version = self._complete_id(prefix, version)
        raw = self._store.get(prefix + version)
        if digest_of(raw) != version:
            raise StoreError(f"the record {version} is damaged", hint="restore it from a backup")
        return msgspec.json.decode(raw, type=MapRecord)

    def versions(self, name: str) -> list[MapRecord]:
        """Return the records of all versions, oldest first, whether or not they are ancestors of the head.

        A version that another process removes meanwhile is left out.

        Raises:
            NotFound: There is no map *name*.
            StoreError: A record is damaged.
        """
        prefix = f"{self._base(name)}versions/"
        records = []
        for info in self._store.list(prefix):
            self._check()
            # Leave out a version whose record another process has removed since the store listed it.
            with contextlib.suppress(NotFound):
                records.append(self.record(name, info.name.removeprefix(prefix)))
        if not records:
            raise NotFound(f"there is no map {name!r}", hint="see rse-pf map list")
        return sorted(records, key=lambda record: (record.number, record.created_s, record.id))

    def data(self, name: str, version: str = "head") -> bytes:
        """Return the encoded map of a version.

        Raises:
            NotFound: There is no such map or version.
            StoreError: The bytes do not have the sha256 of the record.
        """
        record = self.record(name, version)
        raw = self._store.get(self.blob_name(name, record))
        if digest_of(raw) != record.digest:
            raise StoreError(f"map {name!r} {record.id[:12]} is damaged", hint="restore it from a backup")
        return raw

    def blob_name(self, name: str, record: MapRecord) -> str:
        """Return the name of the object that holds the encoded map of a version."""
        return f"{self._base(name)}blobs/{record.digest}"

    def load(self, name: str, version: str = "head") -> MapVersion:
        """Read and decode a version.

        Raises:
            NotFound: There is no such map or version.
            StoreError: The bytes are damaged.
            BadRequest, LimitExceeded: The bytes are not a map, or larger than the limits.
        """
        from rse_pf.maps.format import decode_map

        return decode_map(self.data(name, version), self._max_bytes)

    def images(self, version: MapVersion) -> Iterator[tuple[Keyframe, bytes]]:
        """Yield keyframes of *version* with the bytes of the JPEG files that its provenance refers to.

        The provenance and the objects are not trusted, because a robot may have written them: references to
        another tenant, to objects that do not exist, are no JPEG or have another digest are left out.
        """
        references = version.provenance.get(IMAGES_FIELD)
        keyframes = {str(keyframe.id): keyframe for keyframe in version.keyframes}
        for folder, digests in references.items() if isinstance(references, dict) else ():
            tenant, _, robot = str(folder).partition("/")
            if tenant != name_segment(self._tenant) or not _ROBOT.fullmatch(robot):
                continue
            for number, digest in digests.items() if isinstance(digests, dict) else ():
                if number in keyframes and _ID.fullmatch(str(digest)):
                    data = self._read_image(f"objects/{folder}/{digest}")
                    if hashlib.sha256(data).hexdigest() == digest and data.startswith(_JPEG_MAGIC):
                        yield keyframes[number], data

    def _read_image(self, name: str) -> bytes:
        """Return the bytes of the object *name*; empty if it does not exist or is too large for an image."""
        with contextlib.suppress(NotFound):
            if self._store.head(name).size <= _MAX_IMAGE_BYTES:
                return self._store.get(name)
        return b""

    def move_head(self, name: str, version: str, *, expected: str) -> MapRecord:
        """Set the head to an existing version, as a rollback does, and return its record.

        Args:
            name: Name of the map.
            version: The new head.
            expected: The present head.

        Raises:
            NotFound: There is no such version.
            Conflict: The head is not *expected*.
            Busy: The version is being removed.
        """
        record, expected_record = self.record(name, version), self.record(name, expected)
        self._move_head(name, record, expected_record.id)
        self._on_change("map.head", name, record)
        return record

    def _move_head(self, name: str, record: MapRecord, expected: str) -> None:
        """Move the head from the id *expected* to the version of *record*.

        The version *expected* need not exist any more.
        """
        marks = self._marks(name)
        mark = marks.put(HELD, record.digest)
        try:
            marks.check(record.digest)
            # Raises NotFound if a removal that did not see the mark has removed the version.
            self.record(name, record.id)
            self._swap(name, expected, record.id)
        finally:
            marks.clear(mark)

    def remove(
        self, name: str, choose: Callable[[Sequence[MapRecord], str], Sequence[MapRecord]]
    ) -> list[MapRecord]:
        """Remove versions and return their records; also finish a removal whose process crashed.

        The head, and versions that share their bytes with a version that stays, are not removed even if they
        are chosen.

        Args:
            name: Name of the map.
            choose: Returns the records of the versions to remove, given those of all versions and the id of
                the head; `rse_pf.maps.removal.choose_superseded` is such a function.

        Raises:
            NotFound: There is no map *name*.
            Busy, StoreError: The store is slow or failed; the next call removes the rest.
        """
        # 1. Collect what to remove: the chosen versions, and bytes that crashed removals have marked.
        head, records = self.head(name).id, self.versions(name)
        digests = {record.id: record.digest for record in records}
        marks = self._marks(name)
        abandoned = marks.abandoned()
        by_digest: dict[str, list[MapRecord]] = {
            mark.digest: [] for mark in abandoned if mark.kind == REMOVING
        }
        for record in choose(records, head):
            by_digest.setdefault(record.digest, []).append(record)
        # 2. Remove it in batches.
        removed: list[MapRecord] = []
        all_digests = list(by_digest)
        for first in range(0, len(all_digests), _REMOVED_AT_ONCE):
            batch = {digest: by_digest[digest] for digest in all_digests[first : first + _REMOVED_AT_ONCE]}
            for record in self._remove_batch(name, batch, digests):
                removed.append(record)
                self._on_change("map.remove", name, record)
        # 3. Clear the marks of crashed processes.
        for mark in abandoned:
            marks.clear(mark.name)
        return removed

    def _remove_batch(
        self, name: str, batch: Mapping[str, Sequence[MapRecord]], digests: dict[str, str]
    ) -> Iterator[MapRecord]:
        """Remove the versions of a batch and their bytes, and yield the records of removed versions.

        Args:
            name: Name of the map.
            batch: For each digest of bytes to remove, the records of the versions to remove that have these
                bytes; a list without records if a crashed removal has left only the bytes.
            digests: Digests of versions by their ids; those of versions that are read are added.

        Raises:
            Busy: `MAX_REMOVAL_S` after the begin of the batch, the rest of it was not removed.
        """
        base, marks = self._base(name), self._marks(name)
        began_s = self._wall_clock()
        set_marks: dict[str, str] = {}
        try:
            # 1. Mark the bytes, and then read which versions use them.  Commits and rollbacks first write
            # what uses the bytes, and then read the marks.
            for digest in batch:
                set_marks[digest] = marks.put(REMOVING, digest)
            chosen = {record.id for records in batch.values() for record in records}
            held = marks.marked(HELD)
            used = held | self._used_digests(name, digests, chosen)
            # 2. Remove the charges, the records and then the bytes that nobody uses.
            for digest, records in batch.items():
                if digest in used:
                    continue
                self._check()
                if not 0.0 <= self._wall_clock() - began_s < MAX_REMOVAL_S:
                    raise Busy(
                        f"the store removed fewer than {len(batch)} versions in {MAX_REMOVAL_S:g} s",
                        hint="call again to remove the rest: rse-pf map prune",
                    )
                # Do not clear this mark at the end if an error follows: by it the next removal finds, and
                # deletes, the bytes that this removal left.
                mark = set_marks.pop(digest)
                remove_charges(self._store, self._tenant, name, {record.id for record in records})
                for record in records:
                    self._store.delete(f"{base}versions/{record.id}")
                self._store.delete(f"{base}blobs/{digest}")
                marks.clear(mark)
                yield from records
        finally:
            for mark in set_marks.values():
                marks.clear(mark)

    def _used_digests(self, name: str, digests: dict[str, str], excluded: Collection[str]) -> set[str]:
        """Return the digests of the head and of all versions except those with the ids *excluded*.

        *digests* has the digests by id that are known; those that are read are added to it.
        """
        prefix = f"{self._base(name)}versions/"
        ids = {info.name.removeprefix(prefix) for info in self._store.list(prefix)} - set(excluded)
        head = self._head(name)
        for version in ids | ({head} if head is not None else set()):
            self._check()
            if version not in digests:
                # Leave out a version that another process has just removed: it uses no bytes any more.
                with contextlib.suppress(NotFound):
                    digests[version] = self.record(name, version).digest
        return {digest for version, digest in digests.items() if version in ids or version == head}

    def _marks(self, name: str) -> Marks:
        return Marks(self._store, f"{self._base(name)}blobs/", self._wall_clock)

    def _base(self, name: str) -> str:
        if not _NAME.fullmatch(name):
            raise BadRequest(
                f"{name[:80]!r} is not a valid name of a map",
                hint="use 1 to 64 lower-case letters, digits and hyphens",
            )
        return f"{self._prefix}{name}/"

    def _head(self, name: str) -> str | None:
        try:
            return self._store.get(f"{self._base(name)}head").decode("ascii")
        except NotFound:
            return None

    def _swap(self, name: str, expected: str | None, version: str) -> None:
        """Set the head to the id *version* if the head is *expected* (None: no head), else raise Conflict."""
        expected_bytes = None if expected is None else expected.encode("ascii")
        try:
            self._store.compare_and_swap(f"{self._base(name)}head", expected_bytes, version.encode("ascii"))
        except Conflict as error:
            raise _head_moved(name) from error

    def _complete_id(self, folder: str, prefix: str) -> str:
        """Return the only id in *folder* that begins with *prefix*.

        Raises:
            NotFound: No id or more than one begins so, or *prefix* has fewer than six hexadecimal digits.
        """
        if not re.fullmatch(r"[0-9a-f]{1,64}", prefix) or len(prefix) < _MIN_ID_DIGITS:
            raise NotFound(f"no version {prefix[:80]!r}", hint=f"give {_MIN_ID_DIGITS} or more hex digits")
        ids = [info.name.removeprefix(folder) for info in self._store.list(folder + prefix)]
        if len(ids) != 1:
            count = f"{len(ids)} versions begin" if ids else "no version begins"
            raise NotFound(f"{count} with {prefix!r}", hint="see rse-pf map show NAME --all")
        return ids[0]


def compare_versions(before: MapVersion, after: MapVersion) -> MapDiff:
    """Return the differences from the version *before* to the version *after*."""
    from rse_pf.geometry import pose_difference

    old = {keyframe.id: keyframe.T_world_camera for keyframe in before.keyframes}
    new = {keyframe.id: keyframe.T_world_camera for keyframe in after.keyframes}
    motions = {i: pose_difference(old[i], new[i]) for i in sorted(old.keys() & new.keys())}
    old_edges = {(edge.a, edge.b, str(edge.kind)) for edge in before.edges}
    new_edges = {(edge.a, edge.b, str(edge.kind)) for edge in after.edges}
    return MapDiff(
        added=tuple(sorted(new.keys() - old.keys())),
        removed=tuple(sorted(old.keys() - new.keys())),
        moved=tuple(i for i, (m, deg) in motions.items() if m > _MIN_MOTION_M or deg > _MIN_ROTATION_DEG),
        largest_move_m=max((m for m, _ in motions.values()), default=0.0),
        largest_turn_deg=max((deg for _, deg in motions.values()), default=0.0),
        edges_added=tuple(sorted(new_edges - old_edges)),
        edges_removed=tuple(sorted(old_edges - new_edges)),
        points_before=len(before.points),
        points_after=len(after.points),
    )


@contextlib.contextmanager
def _charge_once(charge: Callable[[int], None], size: int) -> Iterator[None]:
    """Call *charge* with *size* when the context begins; do not undo the charge if the write in it fails.

    `rse_pf.storage.quotas` counts the stored bytes again at intervals, which corrects the charge.
    """
    charge(size)
    yield


def _head_moved(name: str) -> Conflict:
    return Conflict(f"another commit moved the head of map {name!r}", hint="read it, merge, commit again")
