"""Store objects of robots, whole or in parts that survive a crash of the server, within a quota.

An upload is named by the digest of the finished object, and its parts are stored like objects, so that any
data server can resume it after a crash.  Only bytes with the right digest become an object, and the object is
durable when the call that completes it returns.  No name in the store contains text that a robot chose.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager

from rse_pf.auth.tokens import Claims
from rse_pf.config import DataSettings
from rse_pf.data_server.fair_threads import check_wanted, while_wanted
from rse_pf.data_server.routes import Upload
from rse_pf.errors import BadRequest, Conflict, LimitExceeded, NotFound, QuotaExceeded
from rse_pf.identity import object_name
from rse_pf.storage.object_store import DirectoryStore, ObjectInfo, ObjectStore, PresigningStore, digest_of
from rse_pf.storage.quotas import Accounts

__all__ = ["Objects"]

_DIGEST = re.compile(r"[0-9a-f]{64}")
_MAX_OPEN_UPLOADS = 1000  # number of incomplete uploads that one robot may have
UPLOAD_TTL_S = 86_400.0  # an upload that is not finished a day after its begin is deleted
_MIN_PARTS = 64  # number of parts that an upload may have whatever its size
_BYTES_PER_EXTRA_PART = 65_536  # beyond `_MIN_PARTS`, an upload may have a part for each 64 KiB of its size
_HASH_PIECE_BYTES = 1 << 20  # a part is hashed in pieces of this size, so that memory stays bounded


class Objects:
    """Operations of robots on their objects in a store.  They block; call them in a thread."""

    def __init__(
        self,
        store: ObjectStore,
        settings: DataSettings,
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        self._store = store
        self._directory_store = store if isinstance(store, DirectoryStore) else None
        self._settings = settings
        self._wall_clock = wall_clock
        self.accounts = Accounts(store, settings, clock=clock, wall_clock=wall_clock, check=check_wanted)
        self._lock = threading.Lock()  # guards `_writing`; never held while the store works
        self._writing: dict[str, tuple[threading.Lock, int]] = {}
        """The lock of each object that is being written, and how many threads hold or await that lock."""

    def reservation(self, claims: Claims, size: int) -> AbstractContextManager[None]:
        """Return a context manager that reserves *size* bytes of the robot's quota while they are written.

        Entering it raises QuotaExceeded or StoreFull if the bytes are not available.
        """
        return self.accounts.reservation(claims.robot, size, claims.quota("data_bytes") or None)

    def head(self, claims: Claims, digest: str) -> ObjectInfo:
        """Return size and name of an object of this robot in the store.

        Raises:
            NotFound: This robot has no such object, or *digest* is no sha256.
        """
        info = self._find(self.name(claims, digest))
        if info is None:
            raise NotFound("no such object", hint="list yours with GET /data/v1/objects")
        return info

    def name(self, claims: Claims, digest: str) -> str:
        """Return the name of a robot's object in the store; raises NotFound if *digest* is no sha256."""
        if not _DIGEST.fullmatch(digest):
            raise NotFound("no such object", hint="objects are named by sha256, 64 hex digits")
        return object_name(claims.robot, digest)

    def list(self, claims: Claims, after: str, limit: int) -> tuple[list[ObjectInfo], bool]:
        """Return up to *limit* objects with digests greater than *after*, and whether there are more."""
        prefix = object_name(claims.robot, "")
        listed = while_wanted(self._store.list(prefix, after=prefix + after))
        page = list(itertools.islice(listed, limit + 1))
        return page[:limit], len(page) > limit

    def put(self, claims: Claims, digest: str, data: bytes) -> bool:
        """Store the object *data* durably; return False if the robot has it already, and store nothing.

        Raises:
            BadRequest: *digest* is not the sha256 of *data*.
            NotFound: *digest* is no sha256.
            QuotaExceeded, StoreFull, StoreError: Nothing was stored.
        """
        name = self.name(claims, digest)
        if digest_of(data) != digest:
            raise BadRequest("the bytes are not those of the digest", hint="send the object again")
        with self._exclusive(name):
            if self._find(name) is not None:
                return False
            with self.reservation(claims, len(data)):
                self._store.put(name, data)
        return True

    def delete(self, claims: Claims, digest: str) -> None:
        """Remove an object and release its bytes from the quota; a missing object is no error."""
        name = self.name(claims, digest)
        with self._exclusive(name):
            info = self._find(name)
            if info is not None:
                self._store.delete(name)
                self.accounts.release(claims.robot, info.size)

    def begin(self, claims: Claims, digest: str, size: int) -> Upload:
        """Open an upload of *size* bytes and return its state.

        If the upload is open already, return its state; if the object exists, return the state of a complete
        upload.

        Raises:
            Conflict: The open upload has another size.
            LimitExceeded: *size* is above ``data.max_object_bytes``.
            QuotaExceeded, StoreFull, StoreError: Nothing was opened.
        """
        name = self.name(claims, digest)
        if size > self._settings.max_object_bytes:
            raise LimitExceeded(
                f"the object has {size} bytes, the limit is {self._settings.max_object_bytes}",
                hint="split it, or raise data.max_object_bytes",
            )
        if self._find(name) is not None:
            with self._exclusive(name):
                # The robot uploaded the object directly to the bucket, so the upload is complete.
                if self._find_size(claims, digest) is not None:
                    self._drop(self._parts(claims, digest))
            return self._state(digest, size, size)
        with self._exclusive(name):
            opened = self._find_size(claims, digest)
            if opened is None:
                self._check_open_uploads(claims)
                with self.reservation(claims, size):
                    self._store.put(
                        f"{self._parts(claims, digest)}size", f"{size} {self._wall_clock():.0f}".encode()
                    )
                opened = size
            if opened != size:
                raise Conflict(
                    f"this upload has {opened} bytes, not {size}", hint="DELETE the upload and begin it again"
                )
            return self._resume(claims, digest, name, size)

    def progress(self, claims: Claims, digest: str) -> Upload:
        """Return the state of an upload; of a complete one if there is the object only.

        Raises:
            NotFound: There is neither such an upload nor such an object.
        """
        name = self.name(claims, digest)
        with self._exclusive(name):
            opened = self._find_size(claims, digest)
            if opened is None:
                size = self.head(claims, digest).size
                return self._state(digest, size, size)
            return self._resume(claims, digest, name, opened)

    def append(self, claims: Claims, digest: str, offset: int, data: bytes) -> Upload:
        """Store *data* as the part at *offset* and return the state; the last part completes the object.

        If the object is complete already, nothing is stored.  A complete object is durable.  Parts survive a
        crash of this process, but not always a crash of the machine: the robot sends lost parts again, and
        damaged parts are found by the digest.

        Raises:
            NotFound: The upload was never begun, or was abandoned.
            Conflict: *offset* is not the offset of the upload; the message names the right one.
            BadRequest: The part is empty or too long and was not stored, or the complete object has another
                digest and the whole upload was removed.
            LimitExceeded: The upload has too many parts.
            StoreFull, StoreError: The part was not stored; earlier parts stay.
        """
        name = self.name(claims, digest)
        with self._exclusive(name):
            size = self._find_size(claims, digest)
            if size is None:
                info = self._find(name)
                if info is None:
                    raise NotFound("no such upload", hint="begin it with PUT")
                return self._state(digest, info.size, info.size)
            parts = list(self._stored_parts(claims, digest))
            received = sum(part.size for part in parts)
            if offset != received:
                raise Conflict(
                    f"the upload is at offset {received}, not {offset}", hint=f"continue at offset {received}"
                )
            if offset + len(data) > size or (not data and size > offset):
                raise BadRequest(
                    f"a part of {len(data)} bytes at offset {offset} does not fit an upload of {size} bytes",
                    hint="check size, offset and length",
                )
            if len(parts) >= _MIN_PARTS + size // _BYTES_PER_EXTRA_PART:
                raise LimitExceeded(
                    f"the upload has {len(parts)} parts already",
                    hint=f"DELETE it, begin again and send parts of {self._settings.part_bytes} bytes",
                )
            if data:
                self._store_part(f"{self._parts(claims, digest)}part-", parts, offset, data)
            if offset + len(data) == size:
                self._assemble(claims, digest, name, size)
            return self._state(digest, size, offset + len(data))

    def abandon(self, claims: Claims, digest: str) -> None:
        """Remove an upload and its parts; a missing upload is no error."""
        with self._exclusive(self.name(claims, digest)):
            self._discard(claims, digest)

    def sweep(self) -> int:
        """Remove uploads that began more than `UPLOAD_TTL_S` ago; return their number.

        Parts without ``size``, which a crash during the removal of an upload may leave, are removed, too.
        """
        folders: dict[str, float] = {}
        for info in self._store.list("uploads/"):
            folder, _, last = info.name.rpartition("/")
            begun = float(self._store.get(info.name).split()[1]) if last == "size" else 0.0
            folders[folder] = max(begun, folders.get(folder, 0.0))
        oldest = self._wall_clock() - UPLOAD_TTL_S
        old = [folder for folder, begun in folders.items() if begun < oldest]
        for folder in old:
            self._drop(f"{folder}/")
        return len(old)

    def _resume(self, claims: Claims, digest: str, name: str, size: int) -> Upload:
        """Return the state of an upload.

        If a server crashed after it had stored the last part, complete the object first.
        """
        offset = sum(part.size for part in self._stored_parts(claims, digest))
        if not offset and self._find(name) is not None:  # a server crashed after it had completed the object
            self._drop(self._parts(claims, digest))
            return self._state(digest, size, size)
        if offset == size:
            self._assemble(claims, digest, name, size)
        return self._state(digest, size, offset)

    def _store_part(self, prefix: str, parts: Sequence[ObjectInfo], offset: int, data: bytes) -> None:
        """Store the part at *offset*: append it to the only earlier part if the store is a directory.

        In another store each part is an object of its own.
        """
        if self._directory_store is not None and len(parts) < 2:
            self._directory_store.append(f"{prefix}{0:015d}", offset, data)
        else:
            self._store.put(f"{prefix}{offset:015d}", data)

    def _assemble(self, claims: Claims, digest: str, name: str, size: int) -> None:
        parts = list(self._stored_parts(claims, digest))
        try:
            if self._directory_store is not None and len(parts) == 1:
                if self._hash_of(parts[0]) != digest:
                    raise _wrong_digest()
                self._directory_store.adopt(name, parts[0].name, size)
            else:
                self._store.put_pieces(name, self._whole(parts, digest, size))
        except BadRequest:
            self._discard(claims, digest)
            raise
        self._drop(self._parts(claims, digest))

    def _whole(self, parts: Sequence[ObjectInfo], digest: str, size: int) -> Iterator[bytes]:
        """Yield the bytes of *parts*; raise BadRequest after the last if their digest or size is wrong."""
        hashed, received = hashlib.sha256(), 0
        for part in parts:
            data = self._store.get(part.name)
            hashed.update(data)
            received += len(data)
            yield data
        if received != size or hashed.hexdigest() != digest:
            raise _wrong_digest()

    def _hash_of(self, part: ObjectInfo) -> str:
        hashed = hashlib.sha256()
        for start in range(0, part.size, _HASH_PIECE_BYTES):
            check_wanted()
            hashed.update(self._store.get_range(part.name, start, _HASH_PIECE_BYTES))
        return hashed.hexdigest()

    def _discard(self, claims: Claims, digest: str) -> None:
        """Remove an upload that did not become an object, and release its bytes from the quota.

        If the store makes presigned URLs, the bytes stay counted until the next recount.
        """
        size = self._find_size(claims, digest)
        self._drop(self._parts(claims, digest))
        if size is not None and not isinstance(self._store, PresigningStore):
            # With a presigned URL the robot can still store the object, so its bytes stay reserved.
            self.accounts.release(claims.robot, size)

    def _drop(self, prefix: str) -> None:
        """Remove the objects of an upload, whose names begin with *prefix*.

        ``size`` is removed first: without it the upload counts as not begun, also if a crash leaves parts.
        """
        self._store.delete(f"{prefix}size")
        for part in list(self._store.list(prefix)):
            self._store.delete(part.name)

    def _parts(self, claims: Claims, digest: str) -> str:
        return f"uploads/{claims.robot.folder}/{digest}/"

    def _find_size(self, claims: Claims, digest: str) -> int | None:
        try:
            return int(self._store.get(f"{self._parts(claims, digest)}size").split()[0])
        except NotFound:
            return None

    def _stored_parts(self, claims: Claims, digest: str) -> Iterator[ObjectInfo]:
        """Yield the stored parts of an upload in order, up to the first gap.

        Parts that overlap an earlier one are skipped; they exist if a crash cut a part short and the robot
        then sent parts at other offsets.
        """
        prefix, at = f"{self._parts(claims, digest)}part-", 0
        for part in self._store.list(prefix):
            begins = int(part.name.removeprefix(prefix))
            if begins > at:
                return
            if begins == at:
                at += part.size
                yield part

    def _state(self, digest: str, size: int, offset: int) -> Upload:
        return Upload(digest=digest, size=size, offset=offset, part_bytes=self._settings.part_bytes)

    def _find(self, name: str) -> ObjectInfo | None:
        try:
            return self._store.head(name)
        except NotFound:
            return None

    def _check_open_uploads(self, claims: Claims) -> None:
        count = sum(1 for _ in self._store.folders(f"uploads/{claims.robot.folder}/"))
        if count >= _MAX_OPEN_UPLOADS:
            raise QuotaExceeded(
                f"{count} uploads of this robot are not complete, the limit is {_MAX_OPEN_UPLOADS}",
                hint="complete or DELETE them",
            )

    @contextlib.contextmanager
    def _exclusive(self, name: str) -> Iterator[None]:
        """Hold the lock of the object *name*, so that only one request of this server writes it at a time."""
        with self._lock:
            lock, users = self._writing.get(name, (threading.Lock(), 0))
            self._writing[name] = lock, users + 1
        try:
            with lock:
                yield
        finally:
            with self._lock:
                users = self._writing[name][1] - 1
                if users:
                    self._writing[name] = lock, users
                else:
                    del self._writing[name]


def _wrong_digest() -> BadRequest:
    return BadRequest("the parts do not have the digest of the upload", hint="upload it again")
