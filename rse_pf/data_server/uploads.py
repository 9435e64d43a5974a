"""Objects of robots: stored whole or in parts that outlive the server, counted against a quota.

An upload is named by the digest of what it will be, and its parts are objects themselves, so any data
server can go on with it after a crash.  Promises that only bytes with the right digest become an object,
that what was returned for is durable, and that no name holds a word which a robot chose.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rse_pf.auth.tokens import Claims
from rse_pf.config import DataSettings
from rse_pf.errors import BadRequest, Conflict, LimitExceeded, NotFound, QuotaExceeded
from rse_pf.object_store import (
    ObjectInfo,
    ObjectStore,
    digest_of,
    name_segment,
    object_name,
    put_scratch,
)

__all__ = ["Objects", "UploadState", "check_digest"]

_DIGEST = re.compile(r"[0-9a-f]{64}")
_COUNT_AGAIN_S = 60.0
"""Other data servers write, too; their objects are noticed after this."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UploadState:
    """How far an upload has come; ``offset == size`` means the object is stored."""

    digest: str
    size: int
    offset: int
    part_bytes: int


def check_digest(text: str) -> str:
    """Return *text* if it is a sha256 in hex; raises NotFound: nothing else names an object."""
    if not _DIGEST.fullmatch(text):
        raise NotFound("no such object", hint="objects are named by sha256, 64 hex digits")
    return text


class Objects:
    """What one robot may do with the objects of a store.  Blocking; call it in a thread."""

    def __init__(
        self,
        store: ObjectStore,
        settings: DataSettings,
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        self._store = store
        self._settings = settings
        self._clock = clock
        self._wall_clock = wall_clock
        self._lock = threading.Lock()
        self._assembling = threading.Lock()
        self._usage: dict[str, tuple[float, int]] = {}
        self._writing: dict[str, threading.Lock] = {}

    def head(self, who: Claims, digest: str) -> ObjectInfo:
        """Return size and name; raises NotFound, also for what belongs to others."""
        return self._head(self.name(who, digest))

    def name(self, who: Claims, digest: str) -> str:
        """Return where the object of *who* lives in the store."""
        return object_name(who.tenant, who.robot, check_digest(digest))

    def list(self, who: Claims, after: str, limit: int) -> tuple[list[ObjectInfo], bool]:
        """Return up to *limit* objects behind digest *after*, and whether there are more."""
        prefix = object_name(who.tenant, who.robot, "")
        found = [info for info in self._store.list(prefix) if info.name > prefix + after]
        return found[:limit], len(found) > limit

    def put(self, who: Claims, digest: str, data: bytes) -> bool:
        """Store an object; return False if it is there already.

        Raises:
            BadRequest: *data* is not what *digest* says.
            QuotaExceeded, StoreFull, StoreError: Nothing was stored.
        """
        name = self.name(who, digest)
        if digest_of(data) != digest:
            raise BadRequest("the bytes are not those of the digest", hint="send them again")
        if self._exists(name):
            return False
        with self._reserved(who, len(data)):
            self._store.put(name, data)
        return True

    def delete(self, who: Claims, digest: str) -> None:
        """Remove an object; a missing one is no error."""
        self._store.delete(self.name(who, digest))
        self._forget_usage(who)

    def begin(self, who: Claims, digest: str, size: int) -> UploadState:
        """Open an upload of *size* bytes, or return how far it has come; raises Conflict: other size."""
        name = self.name(who, digest)
        if size > self._settings.max_object_bytes:
            raise LimitExceeded(
                f"got {size} bytes, an object has at most {self._settings.max_object_bytes}",
                hint="split it, or raise data.max_object_bytes",
            )
        if self._exists(name):
            with self._lock_of(name):
                if self._opened(who, digest) is not None:  # the robot sent it straight to the bucket
                    self._drop_parts(who, digest)
                    self._forget_usage(who)
            return self._state(digest, size, size)
        with self._lock_of(name):
            opened = self._opened(who, digest)
            if opened is None:
                with self._reserved(who, size):
                    self._store.put(
                        f"{self._parts(who, digest)}size", f"{size} {self._wall_clock():.0f}".encode()
                    )
                opened = size
            if opened != size:
                raise Conflict(f"this upload has {opened} bytes, not {size}", hint="DELETE it and begin anew")
            return self._resumed(who, digest, name, size)

    def progress(self, who: Claims, digest: str) -> UploadState:
        """Return how far an upload has come; raises NotFound."""
        name = self.name(who, digest)
        with self._lock_of(name):
            opened = self._opened(who, digest)
            if opened is None:
                size = self._head(name).size
                return self._state(digest, size, size)
            return self._resumed(who, digest, name, opened)

    def append(self, who: Claims, digest: str, offset: int, data: bytes) -> UploadState:
        """Add a part; the last one makes the object, durably.

        Parts outlive this process.  What a crash of the machine loses of them is sent again, and what it
        spoils is found by the digest: no part waits for the disk.

        Raises:
            NotFound: The upload was never begun, or is over.
            Conflict: *offset* is not where the upload stands: ask for its progress.
            BadRequest: Too much, or the whole is not what the digest says; then nothing is kept.
            StoreFull, StoreError: The part was not stored; what came before it stays.
        """
        name = self.name(who, digest)
        with self._lock_of(name):
            size = self._opened(who, digest)
            if size is None:
                if not self._exists(name):
                    raise NotFound("no such upload", hint="begin it with PUT")
                size = self._head(name).size
                return self._state(digest, size, size)
            stands = self._offset(who, digest)
            if offset != stands:
                raise Conflict(f"the upload stands at {stands}, not at {offset}", hint="go on from there")
            if offset + len(data) > size or (not data and size > offset):
                raise BadRequest(f"{len(data)} bytes at {offset} do not fit {size}", hint="look at the sizes")
            if data:
                put_scratch(self._store, f"{self._parts(who, digest)}part-{offset:015d}", data)
            if offset + len(data) == size:
                self._assemble(who, digest, name, size)
            return self._state(digest, size, offset + len(data))

    def abandon(self, who: Claims, digest: str) -> None:
        """Forget an upload and its parts; a missing one is no error."""
        with self._lock_of(self.name(who, digest)):
            self._drop_parts(who, digest)
        self._forget_usage(who)

    def sweep(self) -> int:
        """Forget uploads that ended in a crash or are older than ``data.upload_ttl_s``; return how many."""
        folders: dict[str, float] = {}
        for info in list(self._store.list("uploads/")):
            folder, _, last = info.name.rpartition("/")
            begun = float(self._store.get(info.name).split()[1]) if last == "size" else 0.0
            folders[folder] = max(begun, folders.get(folder, 0.0))
        oldest = self._wall_clock() - self._settings.upload_ttl_s
        old = [folder for folder, begun in folders.items() if begun < oldest]
        for folder in old:
            self._drop(f"{folder}/")
        return len(old)

    def _resumed(self, who: Claims, digest: str, name: str, size: int) -> UploadState:
        """Return where an upload stands; finish one whose last part outlived the server that took it."""
        offset = self._offset(who, digest)
        if offset == size:
            self._assemble(who, digest, name, size)
        return self._state(digest, size, offset)

    def _assemble(self, who: Claims, digest: str, name: str, size: int) -> None:
        with self._assembling:  # one whole object in memory at a time
            whole = b"".join(self._store.get(part.name) for part in self._stored_parts(who, digest))
            if len(whole) != size or digest_of(whole) != digest:
                self._drop_parts(who, digest)
                self._forget_usage(who)
                raise BadRequest("the parts are not what the digest says", hint="upload it again")
            self._store.put(name, whole)
        self._drop_parts(who, digest)
        self._forget_usage(who)

    def _drop_parts(self, who: Claims, digest: str) -> None:
        self._drop(self._parts(who, digest))

    def _drop(self, prefix: str) -> None:
        """Remove ``size`` first: without it the upload is over, whatever a crash leaves of the parts."""
        self._store.delete(f"{prefix}size")
        for part in list(self._store.list(prefix)):
            self._store.delete(part.name)

    def _parts(self, who: Claims, digest: str) -> str:
        return f"uploads/{name_segment(who.tenant)}/{name_segment(who.robot)}/{digest}/"

    def _opened(self, who: Claims, digest: str) -> int | None:
        try:
            return int(self._store.get(f"{self._parts(who, digest)}size").split()[0])
        except NotFound:
            return None

    def _stored_parts(self, who: Claims, digest: str) -> Iterator[ObjectInfo]:
        """Yield the parts from the beginning up to the first gap; behind a part that was cut some overlap."""
        prefix, at = f"{self._parts(who, digest)}part-", 0
        for part in self._store.list(prefix):
            begins = int(part.name.removeprefix(prefix))
            if begins > at:
                return
            if begins == at:
                at += part.size
                yield part

    def _offset(self, who: Claims, digest: str) -> int:
        return sum(part.size for part in self._stored_parts(who, digest))

    def _state(self, digest: str, size: int, offset: int) -> UploadState:
        return UploadState(digest=digest, size=size, offset=offset, part_bytes=self._settings.part_bytes)

    def _head(self, name: str) -> ObjectInfo:
        try:
            return self._store.head(name)
        except NotFound:
            raise NotFound("no such object", hint="list yours with GET /data/v1/objects") from None

    def _exists(self, name: str) -> bool:
        try:
            self._store.head(name)
        except NotFound:
            return False
        return True

    def _lock_of(self, name: str) -> threading.Lock:
        with self._lock:
            if len(self._writing) > 4096:
                self._writing = {key: lock for key, lock in self._writing.items() if lock.locked()}
            return self._writing.setdefault(name, threading.Lock())

    def _reserved(self, who: Claims, size: int) -> _Reservation:
        return _Reservation(self, who, size)

    def reserve(self, who: Claims, size: int) -> None:
        """Count *size* bytes for *who*; raises QuotaExceeded."""
        key = f"{name_segment(who.tenant)}/{name_segment(who.robot)}/"
        with self._lock:
            counted_at, used = self._usage.get(key, (float("-inf"), 0))
            if self._clock() - counted_at > _COUNT_AGAIN_S:
                used, counted_at = self._count(key), self._clock()
            quota = who.quota("data_bytes") or self._settings.quota_bytes
            if used + size > quota:
                self._usage[key] = counted_at, used
                raise QuotaExceeded(
                    f"{used} + {size} bytes are more than the quota of {quota:.0f}",
                    hint="delete objects, or raise data.quota_bytes",
                )
            self._usage[key] = counted_at, used + size

    def release(self, who: Claims, size: int) -> None:
        """Take back a reservation whose write failed."""
        key = f"{name_segment(who.tenant)}/{name_segment(who.robot)}/"
        with self._lock:
            if key in self._usage:
                counted_at, used = self._usage[key]
                self._usage[key] = counted_at, max(0, used - size)

    def _count(self, key: str) -> int:
        """Return what is stored, and what open uploads will still store."""
        stored = sum(info.size for info in self._store.list(f"objects/{key}"))
        opened = [info.name for info in self._store.list(f"uploads/{key}") if info.name.endswith("/size")]
        return stored + sum(int(self._store.get(name).split()[0]) for name in opened)

    def _forget_usage(self, who: Claims) -> None:
        with self._lock:
            self._usage.pop(f"{name_segment(who.tenant)}/{name_segment(who.robot)}/", None)


class _Reservation:
    """Room for a write; given back if the write fails."""

    def __init__(self, objects: Objects, who: Claims, size: int) -> None:
        self._objects, self._who, self._size = objects, who, size

    def __enter__(self) -> None:
        self._objects.reserve(self._who, self._size)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._objects.release(self._who, self._size)
