"""Objects: bytes under a name, in a folder, in memory, and (in `rse_pf.aws`) in S3.

One contract for all stores: what `put` returned for is there, whole, whatever crashes next.
Promises no knowledge of what the bytes mean, and that no name leaves the store's own folder.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import stat
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol, runtime_checkable

from rse_pf.errors import Conflict, NotFound, StoreError, StoreFull, UsageError
from rse_pf.files import OWNER_ONLY, TEMPORARY_PREFIX, replace_file, sync_folder

__all__ = [
    "DirectoryStore",
    "MemoryStore",
    "ObjectInfo",
    "ObjectStore",
    "PresigningStore",
    "RangedStore",
    "ScratchStore",
    "check_name",
    "digest_of",
    "name_segment",
    "object_name",
    "open_store",
    "put_scratch",
    "read_range",
]

_PLAIN_SEGMENT = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
_LEFT_BEHIND = f"{TEMPORARY_PREFIX}*"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=-]{0,127}(/[A-Za-z0-9][A-Za-z0-9._=-]{0,127}){0,9}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectInfo:
    """What a store knows of an object without reading it."""

    name: str
    size: int


class ObjectStore(Protocol):
    """Bytes by name.  Every method raises StoreError or one of its children, nothing else."""

    def get(self, name: str) -> bytes:
        """Return the object; raises NotFound."""

    def put(self, name: str, data: bytes) -> None:
        """Store the object durably, whole or not at all; raises StoreFull."""

    def head(self, name: str) -> ObjectInfo:
        """Return size and name; raises NotFound."""

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        """Yield the objects whose names begin with *prefix*, sorted by name."""

    def delete(self, name: str) -> None:
        """Remove the object; a missing one is no error."""

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        """Replace the object if it still holds *expected* (None: is missing); raises Conflict."""


@runtime_checkable
class RangedStore(Protocol):
    """A store that reads a piece of an object without reading the rest."""

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return at most *length* bytes from *start* on; raises NotFound."""


@runtime_checkable
class ScratchStore(Protocol):
    """A store that need not wait for the disk where nothing is lost but time."""

    def put_scratch(self, name: str, data: bytes) -> None:
        """Store what outlives this process, but may be lost or cut short when the machine crashes."""


@runtime_checkable
class PresigningStore(Protocol):
    """A store that others may be let into, for one object and a short time; the network is not asked."""

    def presigned_put(self, name: str, *, size: int, sha256: str, life_s: int) -> tuple[str, dict[str, str]]:
        """Return an address and the headers with which exactly these bytes may be PUT there."""

    def presigned_get(self, name: str, *, life_s: int) -> str:
        """Return an address from which the object may be read."""


def read_range(store: ObjectStore, name: str, start: int, length: int) -> bytes:
    """Return at most *length* bytes of an object from *start* on, by the cheapest way of *store*."""
    if isinstance(store, RangedStore):
        return store.get_range(name, start, length)
    return store.get(name)[start : start + length]


def put_scratch(store: ObjectStore, name: str, data: bytes) -> None:
    """Store what a crash of the machine may lose or cut short, by the cheapest way of *store*."""
    if isinstance(store, ScratchStore):
        store.put_scratch(name, data)
    else:
        store.put(name, data)


def name_segment(text: str) -> str:
    """Return a segment of a name for any *text*; two texts never share one (sha256 if it is not plain)."""
    if _PLAIN_SEGMENT.fullmatch(text):
        return text
    return "x=" + digest_of(text.encode("utf-8", "surrogatepass"))


def object_name(tenant: str, robot: str, digest: str) -> str:
    """Return where the object *digest* of a robot lives: ``objects/TENANT/ROBOT/DIGEST``."""
    return f"objects/{name_segment(tenant)}/{name_segment(robot)}/{digest}"


def digest_of(data: bytes) -> str:
    """Return the sha256 of *data* in hex: the name of an immutable object."""
    return hashlib.sha256(data).hexdigest()


def check_name(name: str) -> str:
    """Return *name*, or raise StoreError: only plain path segments, at most ten."""
    if not _NAME.fullmatch(name):
        raise StoreError(
            f"{name[:80]!r} is not a name of an object",
            hint="use segments of letters, digits and . _ = -, joined by /",
        )
    return name


def open_store(
    location: str, openers: Mapping[str, Callable[[str], ObjectStore]] | None = None
) -> ObjectStore:
    """Return the store at ``dir:PATH``, ``memory:``, or what *openers* know by kind, as ``s3:BUCKET``.

    Whoever may use AWS passes ``{"s3": lambda bucket: open_bucket(bucket, region)}`` of `rse_pf.aws`.
    """
    kind, _, place = location.partition(":")
    if kind == "memory":
        return MemoryStore()
    if kind == "dir" and place:
        return DirectoryStore(Path(place))
    if openers and kind in openers and place:
        return openers[kind](place)
    raise UsageError(f"{location!r} names no store", hint="write dir:PATH, s3:BUCKET or memory:")


class MemoryStore:
    """Objects of one process; gone when it ends."""

    def __init__(self) -> None:
        self._objects: dict[str, bytes] = {}
        self._lock = threading.Lock()

    def get(self, name: str) -> bytes:
        """Return the object."""
        with self._lock:
            found = self._objects.get(check_name(name))
        if found is None:
            raise NotFound(f"no object named {name!r}")
        return found

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return a piece of the object."""
        return self.get(name)[start : start + length]

    def put(self, name: str, data: bytes) -> None:
        """Store the object."""
        with self._lock:
            self._objects[check_name(name)] = bytes(data)

    def head(self, name: str) -> ObjectInfo:
        """Return size and name."""
        return ObjectInfo(name=name, size=len(self.get(name)))

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        """Yield the objects whose names begin with *prefix*."""
        with self._lock:
            found = sorted((name, len(data)) for name, data in self._objects.items())
        for name, size in found:
            if name.startswith(prefix):
                yield ObjectInfo(name=name, size=size)

    def delete(self, name: str) -> None:
        """Remove the object."""
        with self._lock:
            self._objects.pop(check_name(name), None)

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        """Replace the object if it still holds *expected*."""
        with self._lock:
            if self._objects.get(check_name(name)) != expected:
                raise Conflict(f"{name!r} was changed meanwhile", hint="read it again and retry")
            self._objects[name] = bytes(data)


class DirectoryStore:
    """Objects as files below one folder, written by temporary file, fsync and rename."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, name: str) -> bytes:
        """Return the object."""
        path = self._path(name)
        with _as_store_errors(name):
            return _read(path)

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return a piece of the object."""
        path = self._path(name)
        with _as_store_errors(name), _open(path) as file:
            file.seek(start)
            return file.read(length)

    def put(self, name: str, data: bytes) -> None:
        """Store the object durably."""
        path = self._path(name)
        with _as_store_errors(name):
            _make_folder(path.parent)
            self._write(path, data)

    def put_scratch(self, name: str, data: bytes) -> None:
        """Store the object, whole, without waiting for the disk."""
        path = self._path(name)
        with _as_store_errors(name):
            _make_folder(path.parent)
            self._write(path, data, is_durable=False)

    def head(self, name: str) -> ObjectInfo:
        """Return size and name."""
        with _as_store_errors(name):
            found = self._path(name).lstat()
        if not stat.S_ISREG(found.st_mode):
            raise NotFound(f"no object named {name!r}")
        return ObjectInfo(name=name, size=found.st_size)

    def list(self, prefix: str = "") -> Iterator[ObjectInfo]:
        """Yield the objects whose names begin with *prefix*."""
        above = prefix.rpartition("/")[0]
        start = self._folder / above if _NAME.fullmatch(above) else self._folder
        if not start.is_dir():
            return
        names = (
            path.relative_to(self._folder).as_posix()
            for path in start.rglob("*")
            if path.is_file() and not path.is_symlink()
        )
        for name in sorted(names):
            if name.startswith(prefix) and _NAME.fullmatch(name):
                with contextlib.suppress(NotFound):
                    yield self.head(name)

    def delete(self, name: str) -> None:
        """Remove the object."""
        path = self._path(name)
        with _as_store_errors(name), contextlib.suppress(NotFound):
            self.head(name)
            path.unlink(missing_ok=True)

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        """Replace the object if it still holds *expected*; a lock file keeps others out."""
        import fcntl

        path = self._path(name)
        with _as_store_errors(name):
            _make_folder(path.parent)
            with (path.parent / f".lock-{path.name}").open("wb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                current = _read(path) if os.path.lexists(path) else None
                if current != expected:
                    raise Conflict(f"{name!r} was changed meanwhile", hint="read it again and retry")
                self._write(path, data)

    def sweep(self, *, now: float, older_than_s: float) -> int:
        """Remove what writers that died left behind; return how many files.  *now* is Unix time."""
        gone = 0
        for path in self._folder.rglob(_LEFT_BEHIND):
            with contextlib.suppress(FileNotFoundError):
                if now - path.lstat().st_mtime > older_than_s:
                    path.unlink()
                    gone += 1
        return gone

    def _path(self, name: str) -> Path:
        return self._folder / check_name(name)

    @staticmethod
    def _write(path: Path, data: bytes, *, is_durable: bool = True) -> None:
        replace_file(path, data, mode=OWNER_ONLY, is_durable=is_durable)


def _read(path: Path) -> bytes:
    """Return a plain file's bytes; a link is no object, wherever it points."""
    with _open(path) as file:
        return file.read()


def _open(path: Path) -> BinaryIO:
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb")


def _make_folder(folder: Path) -> None:
    """Make *folder* and what is missing above it, each entry durable in its parent."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for each in reversed(missing):
        try:
            each.mkdir(exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            raise StoreError(
                f"{each.name!r} is an object, not a folder", hint="choose another name"
            ) from error
        sync_folder(each.parent)


@contextlib.contextmanager
def _as_store_errors(name: str) -> Iterator[None]:
    try:
        yield
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
        raise NotFound(f"no object named {name!r}") from error
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise NotFound(f"no object named {name!r}") from error
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise StoreFull(f"no room for {name!r}", hint="free some space") from error
        raise StoreError(f"{name!r}: {error.strerror}", hint="look at the store's folder") from error
