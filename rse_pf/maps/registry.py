"""The map registry: versions that never change, a head that moves by compare-and-swap.

A commit writes the map, then its record, then the head, each durable before the next; a crash in between
leaves the old head and, at most, an object without a reference.  Every version that a head refers to is
complete, and only one of two robots moves a head.  A version that was removed is gone as a whole; its id may
still be the parent of another.

Layout: ``maps/TENANT/NAME/blobs/DIGEST``, ``.../versions/ID`` (ID is the sha256 of the record), ``.../head``.
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
from rse_pf.maps.charges import remove_charges
from rse_pf.maps.describe import MapSummary, describe_map
from rse_pf.maps.record import MapRecord
from rse_pf.maps.removal import HELD, MOST_S, REMOVING, Marks
from rse_pf.object_store import ObjectStore, digest_of, name_segment

if TYPE_CHECKING:  # importing numpy takes a third of a data server's start, and only maps need it
    from rse_pf.maps.format import Keyframe, MapVersion

__all__ = ["MapContent", "MapDiff", "MapOrigin", "MapRecord", "MapRegistry", "difference"]

_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
_ID = re.compile(r"[0-9a-f]{64}")
_ROBOT = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=-]*")
_MIN_ID = 6
_JPEG, _MAX_IMAGE_BYTES = b"\xff\xd8\xff", 64 << 20
IMAGES_FIELD = "images"
"""Field of the provenance of a live map: digests of images, by robot's folder and id of the keyframe."""
_MAX_MAPS, _MAX_VERSIONS = 10_000, 10_000
"""Of one tenant, and of one map: all of them are read when somebody asks for a list."""
_PIECE_BYTES = 1 << 20
_REMOVED_AT_ONCE = 50
"""So many are marked, and then removed, within `MOST_S` also in a slow store."""
# A keyframe that moved less has not moved: messages are rounded to more than this.
_MOVED_M, _MOVED_DEG = 1e-3, 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class MapDiff:
    """What differs between two versions; keyframes by id, edges as ``(a, b, kind)``."""

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
    """Which bytes a version is."""

    digest: str
    size: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOrigin:
    """Where a version comes from: the head that its maker last read, who made it, when (Unix) and why."""

    parent: str | None
    author: str
    created_s: float
    note: str = ""


class MapRegistry:
    """The maps of one tenant in one store.  Blocking."""

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
        """Make a registry.

        Args:
            store: Where the maps lie.
            tenant: Whose maps.
            max_bytes: Size of a map when it is decoded.
            on_change: Gets ``map.commit``, ``map.head``, ``map.remove`` or ``map.restore``, map and version.
            check: Called between two reads of long work; ends the work by the error that it raises.
            wall_clock: Unix seconds.
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
        """Return the id of the newest version of each map, by its name, sorted."""
        found = {}
        for name in self._store.folders(self._prefix):
            self._check()
            head = self._head(name) if _NAME.fullmatch(name) else None
            if head is not None:
                found[name] = head
        return found

    def commit(
        self, name: str, data: bytes, *, parent: str | None, author: str, created_s: float, note: str = ""
    ) -> MapRecord:
        """Make *data* (of `encode_map`) the next version and the head of map *name*.

        Args:
            name: Lower-case letters, digits and hyphens.
            data: The map.
            parent: The head that the caller last read; None for the first version.
            author: Who made it.
            created_s: Unix seconds.
            note: What was done.

        Raises:
            BadRequest: *data* is not a map, or *name* not a valid name.
            Conflict: The head is not *parent*: read it, merge, and commit again.
            StoreError: The head did not change.
        """
        origin = MapOrigin(parent=parent, author=author, created_s=created_s, note=note)
        return self.commit_charged(name, data, origin, charge=lambda size: None)

    def commit_charged(
        self, name: str, data: bytes, origin: MapOrigin, *, charge: Callable[[int], None]
    ) -> MapRecord:
        """Do the same as `commit`; *charge* gets how many bytes are added before they are written.

        Raises:
            As `commit`, and what *charge* raises to refuse the bytes.
        """
        return self._commit(
            name, describe_map(data, self._max_bytes), MapContent(digest_of(data), len(data)), origin,
            write=lambda blob: self._store.put(blob, data),
            charged=lambda record, size: _charged(charge, size),
        )  # fmt: skip

    def commit_object(
        self,
        name: str,
        source: str,
        summary: MapSummary,
        content: MapContent,
        origin: MapOrigin,
        charged: Callable[[MapRecord, int], AbstractContextManager[None]],
    ) -> MapRecord:
        """Make an object of the store the next version, as `commit` does, without holding it in memory.

        Args:
            name: Of the map.
            source: Name of the object.
            summary: What the map holds, from `rse_pf.maps.describe`.
            content: Digest and size of the object.
            origin: Where the version comes from.
            charged: Returns the context in which the version is written, for its record and the bytes that
                it adds to the store; refuses it by an error.

        Raises:
            As `commit`, and what *charged* raises.
        """

        def pieces() -> Iterator[bytes]:
            hashed = hashlib.sha256()
            for start in range(0, content.size, _PIECE_BYTES):
                self._check()
                piece = self._store.get_range(source, start, _PIECE_BYTES)
                hashed.update(piece)
                yield piece
            if hashed.hexdigest() != content.digest:
                raise StoreError("the bytes are not those of the digest", hint="store the object again")

        return self._commit(
            name, summary, content, origin,
            write=lambda blob: self._store.put_pieces(blob, pieces()), charged=charged,
        )  # fmt: skip

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
        if self._head(name) != parent:
            raise _moved(name)
        before = self.record(name, parent) if parent is not None else None
        self._check_counts(base, is_new=before is None)
        record = MapRecord(
            digest=digest, size=content.size, parent=None if before is None else before.id,
            number=1 if before is None else before.number + 1,
            author=origin.author, created_s=origin.created_s, note=origin.note,
            keyframes=summary.keyframes, edges=summary.edges, points=summary.points, robots=summary.robots,
        )  # fmt: skip
        self._marks(name).check(digest)
        is_new = not self._holds(f"{base}blobs/{digest}")
        with charged(record, content.size if is_new else 0):
            self._put_version(name, record, write, is_new=is_new)
            self._swap(name, parent, record.id)
        self._on_change("map.commit", name, record)
        return record

    def _put_version(
        self, name: str, record: MapRecord, write: Callable[[str], None], *, is_new: bool
    ) -> None:
        """Store a record, and the bytes of its version if they are new.

        Raises:
            Busy: Another process removes these bytes.
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
        if not self._holds(blob):  # a removal that did not see the record has ended: none removes it now
            write(blob)

    def missing(self, name: str, records: Sequence[MapRecord]) -> list[MapRecord]:
        """Return those of *records* that are no whole versions of map *name*: lost or damaged ones."""
        found = []
        for record in records:
            self._check()
            try:
                self.data(name, record.id)
            except StoreError:
                found.append(record)
        return found

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
        """Store versions that were backed up, and set the head.

        Args:
            name: Of the map, which may exist.
            records: Of versions that are missing; their bytes are written in any case.
            head: Id of a version that is there then.
            expected: The present head, None if there is none.
            read: Returns the bytes of a version.
            charge: Gets how many bytes are added before they are written.

        Raises:
            Conflict: The head is not *expected*.
            Busy: A version is being removed.
            StoreError: The head did not change; and what *charge* raises to refuse the bytes.
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
        """Raise LimitExceeded if the tenant has no place for another map, or the map for another version."""
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

    def _holds(self, name: str) -> bool:
        try:
            self._store.head(name)
        except NotFound:
            return False
        return True

    def head(self, name: str) -> MapRecord:
        """Return the record of the head; raises NotFound."""
        head = self._head(name)
        while head is not None:
            try:
                return self.record(name, head)
            except NotFound:
                before, head = head, self._head(name)
                if head == before:
                    raise  # else it was removed when another version was the head
        raise NotFound(f"there is no map {name!r}", hint="see rse-pf map list")

    def record(self, name: str, version: str) -> MapRecord:
        """Return a version's record by its id or an unambiguous beginning of it; ``head`` is the newest."""
        if version == "head":
            return self.head(name)
        prefix = f"{self._base(name)}versions/"
        if not _ID.fullmatch(version):
            version = self._whole_id(prefix, version)
        raw = self._store.get(prefix + version)
        if digest_of(raw) != version:
            raise StoreError(f"the record {version} is damaged", hint="restore it from a backup")
        return msgspec.json.decode(raw, type=MapRecord)

    def versions(self, name: str) -> list[MapRecord]:
        """Return all versions, oldest first, including those that are not ancestors of the head."""
        prefix = f"{self._base(name)}versions/"
        found = []
        for info in self._store.list(prefix):
            self._check()
            with contextlib.suppress(NotFound):  # it was removed meanwhile
                found.append(self.record(name, info.name.removeprefix(prefix)))
        if not found:
            raise NotFound(f"there is no map {name!r}", hint="see rse-pf map list")
        return sorted(found, key=lambda record: (record.number, record.created_s, record.id))

    def data(self, name: str, version: str = "head") -> bytes:
        """Return the bytes of a version, checked by their digest."""
        record = self.record(name, version)
        raw = self._store.get(self.blob_name(name, record))
        if digest_of(raw) != record.digest:
            raise StoreError(f"map {name!r} {record.id[:12]} is damaged", hint="restore it from a backup")
        return raw

    def blob_name(self, name: str, record: MapRecord) -> str:
        """Return the name of a version's bytes in the store."""
        return f"{self._base(name)}blobs/{record.digest}"

    def load(self, name: str, version: str = "head") -> MapVersion:
        """Return a version as a value."""
        from rse_pf.maps.format import decode_map

        return decode_map(self.data(name, version), self._max_bytes)

    def images(self, version: MapVersion) -> Iterator[tuple[Keyframe, bytes]]:
        """Yield keyframes of *version* with the images that its provenance names, of robots of the tenant.

        A robot may have written what is named: an object that is no JPEG, or has another digest, is left out,
        as one that is gone.
        """
        named = version.provenance.get(IMAGES_FIELD)
        keyframes = {str(keyframe.id): keyframe for keyframe in version.keyframes}
        for folder, digests in named.items() if isinstance(named, dict) else ():
            tenant, _, robot = str(folder).partition("/")
            if tenant != name_segment(self._tenant) or not _ROBOT.fullmatch(robot):
                continue
            for number, digest in digests.items() if isinstance(digests, dict) else ():
                if number in keyframes and _ID.fullmatch(str(digest)):
                    data = self._object(f"objects/{folder}/{digest}")
                    if hashlib.sha256(data).hexdigest() == digest and data.startswith(_JPEG):
                        yield keyframes[number], data

    def _object(self, name: str) -> bytes:
        """Return the object *name*, empty if there is none or it is too large for an image."""
        with contextlib.suppress(NotFound):
            if self._store.head(name).size <= _MAX_IMAGE_BYTES:
                return self._store.get(name)
        return b""

    def move_head(self, name: str, version: str, *, expected: str) -> MapRecord:
        """Move the head to an existing *version*, as a rollback does.

        Raises:
            NotFound: There is no such version.
            Conflict: The head is not *expected*.
            Busy: The version is being removed.
        """
        record, before = self.record(name, version), self.record(name, expected)
        self._move_head(name, record, before.id)
        self._on_change("map.head", name, record)
        return record

    def _move_head(self, name: str, record: MapRecord, expected: str) -> None:
        """Move the head from the version *expected*, which need not be there, to that of *record*."""
        marks = self._marks(name)
        mark = marks.put(HELD, record.digest)
        try:
            marks.check(record.digest)
            self.record(name, record.id)  # else a removal that did not see the mark has ended
            self._swap(name, expected, record.id)
        finally:
            marks.clear(mark)

    def remove(
        self, name: str, choose: Callable[[Sequence[MapRecord], str], Sequence[MapRecord]]
    ) -> list[MapRecord]:
        """Remove versions and return them; also finish what a removal that crashed has begun.

        What is the head, or shares its bytes with a version that stays, is not removed, whatever is chosen.

        Args:
            name: Of the map.
            choose: Returns which of all versions to remove, given them and the id of the head.

        Raises:
            NotFound: There is no such map.
            Busy, StoreError: What is not removed yet is removed by the next call.
        """
        head, records = self.head(name).id, self.versions(name)
        digests = {record.id: record.digest for record in records}
        marks = self._marks(name)
        abandoned = marks.abandoned()
        by_digest: dict[str, list[MapRecord]] = {
            mark.digest: [] for mark in abandoned if mark.kind == REMOVING
        }
        for record in choose(records, head):
            by_digest.setdefault(record.digest, []).append(record)
        removed: list[MapRecord] = []
        waiting = list(by_digest)
        for first in range(0, len(waiting), _REMOVED_AT_ONCE):
            batch = {digest: by_digest[digest] for digest in waiting[first : first + _REMOVED_AT_ONCE]}
            for record in self._remove_batch(name, batch, digests):
                removed.append(record)
                self._on_change("map.remove", name, record)
        for mark in abandoned:
            marks.clear(mark.name)
        return removed

    def _remove_batch(
        self, name: str, batch: Mapping[str, Sequence[MapRecord]], digests: dict[str, str]
    ) -> Iterator[MapRecord]:
        """Remove the versions of *batch*, by their digests, and their bytes, and yield them.

        Args:
            name: Of the map.
            batch: All versions to remove that have these bytes; none where only the bytes are left.
            digests: Of versions by their ids; those that are read are added.
        """
        base, marks = self._base(name), self._marks(name)
        began_s = self._wall_clock()
        set_marks: dict[str, str] = {}
        try:
            for digest in batch:
                set_marks[digest] = marks.put(REMOVING, digest)
            chosen = {record.id for records in batch.values() for record in records}
            held = marks.marked(HELD)
            used = held | self._used_digests(name, digests, chosen)  # the head is read after the marks
            for digest, records in batch.items():
                if digest in used:
                    continue
                self._check()
                if not 0.0 <= self._wall_clock() - began_s < MOST_S:
                    raise Busy("the store is too slow to remove versions now", hint="remove the rest later")
                mark = set_marks.pop(digest)  # an error leaves it, so that the next call goes on
                remove_charges(self._store, self._tenant, name, {record.id for record in records})
                for record in records:
                    self._store.delete(f"{base}versions/{record.id}")
                self._store.delete(f"{base}blobs/{digest}")
                marks.clear(mark)
                yield from records
        finally:
            for mark in set_marks.values():
                marks.clear(mark)

    def _used_digests(self, name: str, digests: dict[str, str], without: Collection[str]) -> set[str]:
        """Return the digests of the head and of all versions but those *without*."""
        prefix = f"{self._base(name)}versions/"
        ids = {info.name.removeprefix(prefix) for info in self._store.list(prefix)} - set(without)
        head = self._head(name)
        for version in ids | ({head} if head is not None else set()):
            self._check()
            if version not in digests:
                with contextlib.suppress(NotFound):  # another process has just removed it
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
        known = None if expected is None else expected.encode("ascii")
        try:
            self._store.compare_and_swap(f"{self._base(name)}head", known, version.encode("ascii"))
        except Conflict as error:
            raise _moved(name) from error

    def _whole_id(self, prefix: str, beginning: str) -> str:
        if not re.fullmatch(r"[0-9a-f]{1,64}", beginning) or len(beginning) < _MIN_ID:
            raise NotFound(f"no version {beginning[:80]!r}", hint=f"give {_MIN_ID} or more hex digits")
        found = [info.name.removeprefix(prefix) for info in self._store.list(prefix + beginning)]
        if len(found) != 1:
            how_many = f"{len(found)} versions begin" if found else "no version begins"
            raise NotFound(f"{how_many} with {beginning!r}", hint="see rse-pf map show NAME --all")
        return found[0]


def difference(before: MapVersion, after: MapVersion) -> MapDiff:
    """Return what *after* changed; a keyframe has moved if by more than 1 mm or 0.05 degrees."""
    from rse_pf.geometry import pose_difference

    old = {keyframe.id: keyframe.T_world_camera for keyframe in before.keyframes}
    new = {keyframe.id: keyframe.T_world_camera for keyframe in after.keyframes}
    moves = {each: pose_difference(old[each], new[each]) for each in sorted(old.keys() & new.keys())}
    old_edges = {(edge.a, edge.b, str(edge.kind)) for edge in before.edges}
    new_edges = {(edge.a, edge.b, str(edge.kind)) for edge in after.edges}
    return MapDiff(
        added=tuple(sorted(new.keys() - old.keys())),
        removed=tuple(sorted(old.keys() - new.keys())),
        moved=tuple(each for each, (m, deg) in moves.items() if m > _MOVED_M or deg > _MOVED_DEG),
        largest_move_m=max((m for m, _ in moves.values()), default=0.0),
        largest_turn_deg=max((deg for _, deg in moves.values()), default=0.0),
        edges_added=tuple(sorted(new_edges - old_edges)),
        edges_removed=tuple(sorted(old_edges - new_edges)),
        points_before=len(before.points),
        points_after=len(after.points),
    )


@contextlib.contextmanager
def _charged(charge: Callable[[int], None], size: int) -> Iterator[None]:
    """Charge the bytes once; what was charged and not written is found when they are counted again."""
    charge(size)
    yield


def _moved(name: str) -> Conflict:
    return Conflict(f"another commit moved the head of map {name!r}", hint="read it, merge, commit again")
