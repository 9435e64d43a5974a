"""Objects: bytes under a name, in a folder, in memory, and (in `rse_pf.aws`) in S3.

All stores follow one contract: once `put` returns, the object is complete and durable, whatever crashes
next.  No name can refer to a file outside the folder of a store.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
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
    "is_name",
    "name_segment",
    "open_store",
    "put_scratch",
    "read_range",
]

_PLAIN_SEGMENT = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=-]{0,127}(/[A-Za-z0-9][A-Za-z0-9._=-]{0,127}){0,9}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectInfo:
    """Name and size of an object, known without reading it."""

    name: str
    size: int


class ObjectStore(Protocol):
    """Bytes by name.  Every method raises only StoreError and its subclasses."""

    def get(self, name: str) -> bytes:
        """Return the object; raises NotFound."""

    def put(self, name: str, data: bytes) -> None:
        """Store the object durably and atomically; raises StoreFull."""

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
    """A store that can read a part of an object."""

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return at most *length* bytes from *start* on; raises NotFound."""


@runtime_checkable
class ScratchStore(Protocol):
    """A store that can write without waiting for the disk."""

    def put_scratch(self, name: str, data: bytes) -> None:
        """Store an object that survives this process, but may be lost or truncated if the machine crashes."""


@runtime_checkable
class PresigningStore(Protocol):
    """A store that can sign URLs for one object and a limited time, without any request."""

    def presigned_put(self, name: str, *, size: int, sha256: str, ttl_s: int) -> tuple[str, dict[str, str]]:
        """Return a URL and the headers with which exactly these bytes can be PUT."""

    def presigned_get(self, name: str, *, ttl_s: int) -> str:
        """Return a URL from which the object can be read."""


def read_range(store: ObjectStore, name: str, start: int, length: int) -> bytes:
    """Return at most *length* bytes of an object from *start* on, in the cheapest way."""
    if isinstance(store, RangedStore):
        return store.get_range(name, start, length)
    return store.get(name)[start : start + length]


def put_scratch(store: ObjectStore, name: str, data: bytes) -> None:
    """Store an object that a crash of the machine may lose or truncate, in the cheapest way."""
    if isinstance(store, ScratchStore):
        store.put_scratch(name, data)
    else:
        store.put(name, data)


def name_segment(text: str) -> str:
    """Return a segment of a name for any *text*; no two texts share one (the sha256 if it is not plain)."""
    if _PLAIN_SEGMENT.fullmatch(text):
        return text
    return "x=" + digest_of(text.encode("utf-8", "surrogatepass"))


def digest_of(data: bytes) -> str:
    """Return the sha256 of *data* in hex: the name of an immutable object."""
    return hashlib.sha256(data).hexdigest()


def is_name(name: str) -> bool:
    """Return whether *name* consists of at most ten plain path segments."""
    return _NAME.fullmatch(name) is not None


def check_name(name: str) -> str:
    """Return *name*; raises StoreError unless it consists of at most ten plain path segments."""
    if not is_name(name):
        raise StoreError(
            f"{name[:80]!r} is not a name of an object",
            hint="use segments of letters, digits and . _ = -, joined by /",
        )
    return name


def open_store(
    location: str, openers: Mapping[str, Callable[[str], ObjectStore]] | None = None
) -> ObjectStore:
    """Return the store at ``dir:PATH``, ``memory:``, or what *openers* know by kind, as ``s3:BUCKET``.

    For S3 pass ``{"s3": lambda bucket: open_bucket(bucket, region)}`` with `open_bucket` of `rse_pf.aws`.
    """
    kind, _, place = location.partition(":")
    if kind == "memory":
        return MemoryStore()
    if kind == "dir" and place:
        return DirectoryStore(Path(place))
    if openers and kind in openers and place:
        return openers[kind](place)
    raise UsageError(f"{location!r} is not a store", hint="write dir:PATH, s3:BUCKET or memory:")


class MemoryStore:
    """Objects in the memory of one process."""

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
        """Return a part of the object."""
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
        """Return a part of the object."""
        path = self._path(name)
        with _as_store_errors(name), _open(path) as file:
            file.seek(start)
            return file.read(length)

    def put(self, name: str, data: bytes) -> None:
        """Store the object durably."""
        path = self._path(name)
        with _as_store_errors(name):
            _make_folder(path.parent)
            replace_file(path, data, mode=OWNER_ONLY, is_durable=True)

    def put_scratch(self, name: str, data: bytes) -> None:
        """Store the object atomically, without waiting for the disk."""
        path = self._path(name)
        with _as_store_errors(name):
            _make_folder(path.parent)
            replace_file(path, data, mode=OWNER_ONLY)

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
        """Replace the object if it still holds *expected*; a lock file excludes other writers."""
        path = self._path(name)
        with _as_store_errors(name):
            _make_folder(path.parent)
            with (path.parent / f".lock-{path.name}").open("wb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                current = _read(path) if os.path.lexists(path) else None
                if current != expected:
                    raise Conflict(f"{name!r} was changed meanwhile", hint="read it again and retry")
                replace_file(path, data, mode=OWNER_ONLY, is_durable=True)

    def sweep(self, *, now: float, older_than_s: float) -> int:
        """Remove the temporary files of writers that crashed and return their number; *now* is Unix time."""
        removed = 0
        for path in self._folder.rglob(f"{TEMPORARY_PREFIX}*"):
            with contextlib.suppress(FileNotFoundError):
                if now - path.lstat().st_mtime > older_than_s:
                    path.unlink()
                    removed += 1
        return removed

    def _path(self, name: str) -> Path:
        return self._folder / check_name(name)


def _read(path: Path) -> bytes:
    """Return the content of a regular file; a symbolic link is not an object."""
    with _open(path) as file:
        return file.read()


def _open(path: Path) -> BinaryIO:
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb")


def _make_folder(folder: Path) -> None:
    """Create *folder* and its missing parents, each of them durably."""
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
            raise StoreFull(f"no space left for {name!r}", hint="free some space") from error
        raise StoreError(f"{name!r}: {error.strerror}", hint="check the folder of the store") from error
