"""Object stores: bytes under names, in a folder or in memory; the store in S3 is in `rse_pf.aws`.

After `put` of a folder or of S3 has returned, the object is complete and survives a crash of the machine.  No
name can refer to a file outside the folder of a store.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import secrets
import stat
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol, runtime_checkable

from rse_pf.errors import Busy, Conflict, NotFound, StoreError, StoreFull, UsageError
from rse_pf.storage.disk_reserve import DiskReserve, is_full
from rse_pf.storage.files import OWNER_ONLY, TEMPORARY_PREFIX, replace_file, sync_folder

__all__ = [
    "MIN_CHARGE_BYTES",
    "DirectoryStore",
    "MemoryStore",
    "ObjectInfo",
    "ObjectStore",
    "PresigningStore",
    "Usage",
    "charge_of",
    "check_name",
    "digest_of",
    "is_name",
    "open_store",
]

_Names = list[str]  # a name for the type in classes that have a method "list"
_SHARD = "+"  # begins the name of each subfolder for objects of a robot; two digits of their digests follow
_LOCK = ".lock-"  # begins the names of lock files
_DIGEST = re.compile(r"[0-9a-f]{64}")  # a sha256 in hex, the last segment of the name of a robot's object
_WRITE_TRIES = 8  # attempts to write an object whose folder other processes remove at the same time
# Nanoseconds after the last change of a folder in which it may change again without a newer time stamp, so
# that its usage is not remembered.
_UNSETTLED_NS = 100_000_000
_MAX_MEASURED = 100_000  # folders whose usage is remembered; above that, all are forgotten
# The name of an object: one to ten segments of up to 128 characters, joined by slashes.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._=-]{0,127}(/[A-Za-z0-9][A-Za-z0-9._=-]{0,127}){0,9}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectInfo:
    """The name of an object and its size in bytes, without its content."""

    name: str
    size: int


MIN_CHARGE_BYTES = 4096
"""Bytes of a quota that an object uses at least: even the shortest file takes a block and an inode."""


@dataclass(frozen=True, slots=True)
class Usage:
    """The number of some objects, and the bytes of a quota that they use together (see `charge_of`)."""

    objects: int = 0
    charged_bytes: int = 0

    def __add__(self, other: Usage) -> Usage:
        """Return the usage of the objects in this usage and in *other* together."""
        return Usage(self.objects + other.objects, self.charged_bytes + other.charged_bytes)


class ObjectStore(Protocol):
    """A store of objects, which are bytes under names.  Its methods raise only subclasses of StoreError."""

    def get(self, name: str) -> bytes:
        """Return the bytes of the object *name*; raises NotFound."""

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return at most *length* bytes of the object from byte *start* on; raises NotFound."""

    def put(self, name: str, data: bytes) -> None:
        """Store *data* as the object *name*, or replace it, durably and in one step; raises StoreFull."""

    def put_pieces(self, name: str, pieces: Iterator[bytes]) -> None:
        """Store the joined *pieces* like `put`; if *pieces* raises an error, nothing is stored."""

    def head(self, name: str) -> ObjectInfo:
        """Return name and size of the object without reading it; raises NotFound."""

    def list(self, prefix: str = "", after: str = "") -> Iterator[ObjectInfo]:
        """Yield the objects whose names begin with *prefix* and are greater than *after*, sorted by name."""

    def folders(self, prefix: str) -> Iterator[str]:
        """Yield, sorted, the names of the folders directly below the folder *prefix*, which ends with /."""

    def usage(self, prefix: str) -> Usage:
        """Return the usage of all objects below the folder *prefix*, which ends with a slash."""

    def delete(self, name: str) -> None:
        """Remove the object *name*; a missing object is no error."""

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        """Replace the object by *data* if its content is *expected*; None means that it must be missing.

        Raises:
            Conflict: The object has another content, or exists; it is not changed.
        """


@runtime_checkable
class PresigningStore(Protocol):
    """A store that can sign URLs for one object and a limited time, without a request: a bucket of S3."""

    def presigned_put(self, name: str, *, size: int, sha256: str, ttl_s: int) -> tuple[str, dict[str, str]]:
        """Return a URL, and headers with which a client can PUT the object *name* there for *ttl_s* seconds.

        Only bytes of this *size* and *sha256* (hex) are accepted.
        """

    def presigned_get(self, name: str, *, ttl_s: int) -> str:
        """Return a URL from which a client can read the object *name* for *ttl_s* seconds."""


def charge_of(size: int) -> int:
    """Return how many bytes of a quota an object of *size* bytes uses: at least `MIN_CHARGE_BYTES`."""
    return max(size, MIN_CHARGE_BYTES)


def usage_of(listed: Iterable[ObjectInfo]) -> Usage:
    """Return the usage of the objects in *listed* together."""
    return sum((Usage(1, charge_of(info.size)) for info in listed), Usage())


def digest_of(data: bytes) -> str:
    """Return the sha256 of *data* in hex, which is the name of an immutable object with this content."""
    return hashlib.sha256(data).hexdigest()


def is_name(name: str) -> bool:
    """Return whether *name* is valid: one to ten segments of letters, digits and ``. _ = -``, joined by /."""
    return _NAME.fullmatch(name) is not None


def check_name(name: str) -> str:
    """Return *name*; raises StoreError if it is not valid by `is_name`."""
    if not is_name(name):
        raise StoreError(
            f"{name[:80]!r} is not a name of an object",
            hint="use segments of letters, digits and . _ = -, joined by /",
        )
    return name


def open_store(
    location: str, openers: Mapping[str, Callable[[str], ObjectStore]] | None = None
) -> ObjectStore:
    """Return the store at *location*: ``dir:PATH``, ``memory:``, or ``KIND:PLACE`` with a kind in *openers*.

    Args:
        location: The store, as in the setting ``data.store``.
        openers: By kind, a function from the place to the store.  For ``s3:BUCKET`` pass
            ``{"s3": lambda bucket: open_bucket(bucket, region)}`` with `open_bucket` of `rse_pf.aws`.

    Raises:
        UsageError: *location* is malformed, or has an unknown kind.
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
    """An `ObjectStore` in the memory of one process; its objects are lost when the process exits."""

    def __init__(self) -> None:
        self._objects: dict[str, bytes] = {}
        self._lock = threading.Lock()

    def get(self, name: str) -> bytes:
        """Return the bytes of the object *name*; raises NotFound."""
        with self._lock:
            data = self._objects.get(check_name(name))
        if data is None:
            raise NotFound(f"no object named {name!r}")
        return data

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return at most *length* bytes of the object from byte *start* on; raises NotFound."""
        return self.get(name)[start : start + length]

    def put(self, name: str, data: bytes) -> None:
        """Store *data* as the object *name*, or replace it, in this process only."""
        with self._lock:
            self._objects[check_name(name)] = bytes(data)

    def put_pieces(self, name: str, pieces: Iterator[bytes]) -> None:
        """Store the joined *pieces* as the object *name*; if *pieces* raises an error, nothing is stored."""
        self.put(name, b"".join(pieces))

    def head(self, name: str) -> ObjectInfo:
        """Return name and size of the object; raises NotFound."""
        return ObjectInfo(name=name, size=len(self.get(name)))

    def list(self, prefix: str = "", after: str = "") -> Iterator[ObjectInfo]:
        """Yield the objects whose names begin with *prefix* and are greater than *after*, sorted by name."""
        with self._lock:
            sizes = sorted(
                (name, len(data))
                for name, data in self._objects.items()
                if name.startswith(prefix) and name > after
            )
        for name, size in sizes:
            yield ObjectInfo(name=name, size=size)

    def folders(self, prefix: str) -> Iterator[str]:
        """Yield, sorted, the names of the folders directly below the folder *prefix*, which ends with /."""
        rests = (info.name.removeprefix(prefix).partition("/") for info in self.list(prefix))
        yield from sorted({folder for folder, slash, _ in rests if slash})

    def usage(self, prefix: str) -> Usage:
        """Return the usage of all objects below the folder *prefix* together."""
        return usage_of(self.list(prefix))

    def delete(self, name: str) -> None:
        """Remove the object *name*; a missing object is no error."""
        with self._lock:
            self._objects.pop(check_name(name), None)

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        """Replace the object if its content is *expected* (None: missing); raises Conflict otherwise."""
        with self._lock:
            if self._objects.get(check_name(name)) != expected:
                raise Conflict(f"{name!r} was changed meanwhile", hint="read it again and retry")
            self._objects[name] = bytes(data)


class DirectoryStore:
    """An `ObjectStore` of files below one folder, written by temporary file, fsync and rename.

    Only `append` writes into the file itself, without fsync.

    The objects of a robot are in up to 256 folders by the first two digits of their digests, as
    ``objects/TENANT/ROBOT/+ab/DIGEST``, so that each page of a listing reads a few small folders only.
    These folders, whose names begin with `_SHARD`, are not part of the names of the objects.
    """

    def __init__(self, folder: Path, reserve: DiskReserve | None = None) -> None:
        """Create nothing yet.

        Args:
            folder: Path of the folder, which need not exist.
            reserve: Space that `compare_and_swap` uses on a full disk; None if there is none.
        """
        self._folder, self._root = folder, str(folder)
        self._reserve = reserve
        self._measured: dict[str, tuple[int, Usage, _Names]] = {}

    def get(self, name: str) -> bytes:
        """Return the bytes of the object *name*; raises NotFound."""
        with _as_store_errors(name), _open(self._path(name)) as file:
            return file.read()

    def get_cached(self, name: str, start: int, length: int) -> tuple[int, bytes] | None:
        """Return the size of the object and at most *length* of its bytes from *start* on, without a wait.

        None if the object is missing, or these bytes are not in the page cache, so that a read would wait for
        the disk.
        """
        return _read_cached(self._path(name), start, length)

    def get_range(self, name: str, start: int, length: int) -> bytes:
        """Return at most *length* bytes of the object from byte *start* on; raises NotFound."""
        with _as_store_errors(name), _open(self._path(name)) as file:
            return os.pread(file.fileno(), length, start)

    def put(self, name: str, data: bytes) -> None:
        """Store *data* as the object *name*, or replace it, durably and in one step; raises StoreFull."""
        self._write(name, lambda path: replace_file(path, data, mode=OWNER_ONLY, is_durable=True))

    def put_pieces(self, name: str, pieces: Iterator[bytes]) -> None:
        """Store the joined *pieces* like `put`; if *pieces* raises an error, nothing is stored."""
        self._write(name, lambda path: _replace_by_pieces(path, pieces))

    def append(self, name: str, offset: int, data: bytes) -> None:
        """Append *data* to the object *name*, whose present size must be *offset*; 0 creates it if missing.

        The data survive the end of this process, but a crash of the machine may damage them.  A lock on the
        file excludes other writers.

        Raises:
            NotFound: *offset* is above 0, and the object is missing.
            Conflict: The object has another size.
            Busy: Another process writes to the object.
        """

        def add(path: str) -> None:
            with _locked(path, 0 if offset else os.O_CREAT, offset) as handle:
                try:
                    view, at = memoryview(data), offset
                    while view:
                        count = os.pwrite(handle, view, at)
                        view, at = view[count:], at + count
                except OSError:
                    os.ftruncate(handle, offset)
                    raise

        self._write(name, add)

    def adopt(self, name: str, source: str, size: int) -> None:
        """Rename the object *source* to *name* durably, if it has *size* bytes.

        Raises:
            NotFound: *source* is missing.
            Conflict: *source* has another size.
            Busy: Another process writes to *source*.
        """
        grown = self._path(source)

        def rename(path: str) -> None:
            with _locked(grown, 0, size) as handle:
                os.fsync(handle)
                os.rename(grown, path)
            sync_folder(os.path.dirname(path))

        self._write(name, rename)

    def head(self, name: str) -> ObjectInfo:
        """Return name and size of the object; raises NotFound."""
        with _as_store_errors(name):
            status = os.lstat(self._path(name))
        if not stat.S_ISREG(status.st_mode):
            raise NotFound(f"no object named {name!r}")
        return ObjectInfo(name=name, size=status.st_size)

    def list(self, prefix: str = "", after: str = "") -> Iterator[ObjectInfo]:
        """Yield the objects whose names begin with *prefix* and are greater than *after*, sorted by name.

        A folder is read only when the iteration reaches it.
        """
        above, slash, _ = prefix.rpartition("/")
        if not slash or is_name(above):
            yield from self._walk(above + slash, above + slash, prefix, after)

    def folders(self, prefix: str) -> Iterator[str]:
        """Yield, sorted, the names of the folders directly below the folder *prefix*, which ends with /."""
        yield from sorted(name for name in self._scan(prefix)[1] if is_name(name))

    def usage(self, prefix: str) -> Usage:
        """Return the usage of all objects below *prefix*; only folders that have changed are read again."""
        place = f"{self._folder}/{prefix}"
        with _as_store_errors(prefix):
            try:
                changed_ns = os.stat(place).st_mtime_ns
            except (FileNotFoundError, NotADirectoryError):
                return Usage()
        known = self._measured.get(place)
        if known is None or known[0] != changed_ns:
            known = changed_ns, *self._measure(prefix)
            if time.time_ns() - changed_ns > _UNSETTLED_NS:
                if len(self._measured) >= _MAX_MEASURED:
                    self._measured.clear()
                self._measured[place] = known
        total = known[1]
        for folder in known[2]:
            total += self.usage(f"{prefix}{folder}/")
        return total

    def space(self) -> tuple[int, int]:
        """Return the free bytes and the size in bytes of the file system of the folder."""
        folder = self._folder
        while True:
            with _as_store_errors(str(self._folder)), contextlib.suppress(FileNotFoundError):
                disk = os.statvfs(folder)
                return disk.f_bavail * disk.f_frsize, disk.f_blocks * disk.f_frsize
            folder = folder.parent

    def delete(self, name: str) -> None:
        """Remove the object, and its folder if that is empty then; a missing object is no error."""
        path = self._path(name)
        folder, lock = os.path.dirname(path), _lock_of(path)
        with contextlib.suppress(NotFound), _as_store_errors(name):
            self.head(name)
            with _hold_lock(lock) if os.path.exists(lock) else contextlib.nullcontext():
                for each in (path, lock):
                    with contextlib.suppress(FileNotFoundError):
                        os.unlink(each)
            if folder != self._root and not os.path.basename(folder).startswith(_SHARD):
                with contextlib.suppress(OSError):  # the folder is not empty
                    os.rmdir(folder)

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        """Replace the object if its content is *expected* (None: missing); raises Conflict otherwise.

        A lock file next to the object excludes other writers.
        """

        def check() -> None:
            try:
                current = self.get(name)
            except NotFound:
                current = None
            if current != expected:
                raise Conflict(f"{name!r} was changed meanwhile", hint="read it again and retry")

        def swap(path: str) -> None:
            check()
            lock = _lock_of(path)
            while True:
                # The data are written before the lock is taken, so that a process that is paused while it
                # writes does not hold the lock.
                try:
                    with _temporary(path, [data]) as temporary, _hold_lock(lock):
                        check()
                        os.replace(temporary, path)
                    break
                except OSError as error:
                    if self._reserve is None or not is_full(error) or not self._reserve.release(len(data)):
                        raise
            sync_folder(os.path.dirname(path))

        self._write(name, swap)

    def sweep(self, *, now: float, older_than_s: float) -> int:
        """Remove the temporary files that crashed writers left, and return the number of removed files.

        Args:
            now: Unix seconds.
            older_than_s: Age in seconds above which a file is removed: no writer uses it any more.
        """
        removed = 0
        for at, _, names in os.walk(self._folder):
            for path in (Path(at, name) for name in names if name.startswith(TEMPORARY_PREFIX)):
                with contextlib.suppress(FileNotFoundError):
                    if now - path.lstat().st_mtime > older_than_s:
                        path.unlink()
                        removed += 1
        return removed

    def _path(self, name: str) -> str:
        """Return the path of the file of the object *name*; raises StoreError for an invalid name."""
        path = f"{self._root}/{check_name(name)}"
        folder, _, last = path.rpartition("/")
        is_of_robot = name.startswith("objects/") and _DIGEST.fullmatch(last) is not None
        return f"{folder}/{_SHARD}{last[:2]}/{last}" if is_of_robot else path

    def _write(self, name: str, write: Callable[[str], None]) -> None:
        """Call *write* with the path of the object; if its folder is missing, create the folder and repeat.

        Errors of the file system become errors of the store.
        """
        path = self._path(name)
        changed: list[str] = []
        with _as_store_errors(name):
            for tries_left in reversed(range(_WRITE_TRIES)):
                try:
                    write(path)
                except (FileNotFoundError, NotADirectoryError):
                    if not tries_left:
                        raise
                    changed += _make_folder(os.path.dirname(path))
                else:
                    break
            # The folders are synced last, so that the file system's journal commits them with the file.
            for folder in reversed(changed):
                sync_folder(folder)

    def _measure(self, prefix: str) -> tuple[Usage, _Names]:
        """Return the usage of the objects directly in the folder *prefix*, and the names of its folders."""
        objects = charged = 0
        files, folders = self._scan(prefix)
        for name in files:
            if is_name(name):
                with contextlib.suppress(FileNotFoundError):
                    objects += 1
                    charged += charge_of(os.lstat(f"{self._folder}/{prefix}{name}").st_size)
        return Usage(objects, charged), folders

    def _scan(self, at: str) -> tuple[_Names, _Names]:
        """Return the names of the files and of the folders in the folder *at*, which is "" or ends with /.

        Both lists are empty if there is no such folder.
        """
        files, folders = [], []
        with (
            _as_store_errors(at), contextlib.suppress(FileNotFoundError, NotADirectoryError),
            os.scandir(f"{self._folder}/{at}") as entries,
        ):  # fmt: skip
            for entry in entries:
                if entry.is_file(follow_symlinks=False):
                    files.append(entry.name)
                elif entry.is_dir(follow_symlinks=False):
                    folders.append(entry.name)
        return files, folders

    def _walk(self, place: str, at: str, prefix: str, after: str) -> Iterator[ObjectInfo]:
        """Yield the objects in the folder *place* and below, sorted by name, that fit *prefix* and *after*.

        *at* is the beginning of their names: *place* without folders that begin with `_SHARD`.
        """
        files, folders = self._scan(place)
        rows = [(name, name) for name in files]
        # The names of the objects in the folder +ab begin with ab, so this folder is sorted as ab.
        rows += [(name[1:] if name.startswith(_SHARD) else f"{name}/", f"{name}/") for name in folders]
        for begin, entry in sorted(rows):
            name = at + begin
            if not entry.endswith("/"):
                if name.startswith(prefix) and name > after and is_name(name):
                    with contextlib.suppress(FileNotFoundError):
                        size = os.lstat(f"{self._folder}/{place}{entry}").st_size
                        yield ObjectInfo(name=name, size=size)
            elif (name.startswith(prefix) or prefix.startswith(name)) and (
                name >= after or after.startswith(name)
            ):
                yield from self._walk(place + entry, at if entry.startswith(_SHARD) else name, prefix, after)


def _open(path: str) -> BinaryIO:
    return os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb")


def _read_cached(path: str, start: int, length: int) -> tuple[int, bytes] | None:
    """Return the size of the file *path*, and at most *length* of its bytes from *start* on.

    None if there is no such regular file, or these bytes are not in the page cache, so that reading them
    would wait for the disk.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError:
        return None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            return None
        data = bytearray(max(0, min(length, status.st_size - start)))
        got = os.preadv(descriptor, [data], start, os.RWF_NOWAIT) if data else 0
        return (status.st_size, bytes(data)) if got == len(data) else None
    except OSError:  # a part is not in the page cache, or the file system does not support the request
        return None
    finally:
        os.close(descriptor)


def _lock_of(path: str) -> str:
    folder, _, last = path.rpartition("/")
    return f"{folder}/{_LOCK}{last}"


def _make_folder(folder: str) -> list[str]:
    """Create *folder* and its missing parents; return the parents of all of these, for the caller to sync."""
    missing = []
    while not os.path.isdir(folder):
        missing.append(folder)
        folder = os.path.dirname(folder) or "."
    for made in reversed(missing):
        try:
            os.mkdir(made)
        except FileNotFoundError:
            break  # another process removed the parent meanwhile: the caller tries again
        except FileExistsError as error:
            if _is_no_folder(made):
                raise StoreError(
                    f"{os.path.basename(made)!r} is an object, not a folder", hint="choose another name"
                ) from error
    return [os.path.dirname(made) or "." for made in reversed(missing)]


def _is_no_folder(path: str) -> bool:
    """Return whether something that is not a folder is at *path*; False if nothing is there any more."""
    try:
        return not stat.S_ISDIR(os.stat(path).st_mode)
    except FileNotFoundError:
        return os.path.islink(path)


@contextlib.contextmanager
def _locked(path: str, flags: int, size: int) -> Iterator[int]:
    """Open the file *path* with *flags*, lock it, and yield its descriptor.

    Raises:
        Conflict: The file does not have *size* bytes, or was replaced meanwhile.
        Busy: Another process holds the lock.
    """
    handle = os.open(path, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC | flags, OWNER_ONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not _is_at(path, handle) or os.fstat(handle).st_size != size:
            raise Conflict(
                f"the upload does not have {size} bytes, or was changed meanwhile",
                hint="ask the server how many bytes it has, and continue there",
            )
        yield handle
    except BlockingIOError as error:
        raise Busy("another server writes this upload", hint="retry later", retry_after_ms=1000.0) from error
    finally:
        os.close(handle)


def _replace_by_pieces(path: str, pieces: Iterator[bytes]) -> None:
    with _temporary(path, pieces) as temporary:
        os.replace(temporary, path)
    sync_folder(os.path.dirname(path))


@contextlib.contextmanager
def _temporary(path: str, pieces: Iterable[bytes]) -> Iterator[str]:
    """Write *pieces* durably to a temporary file in the folder of *path*, and yield its path.

    The file is removed if writing fails or the caller raises an error.
    """
    temporary = f"{os.path.dirname(path)}/{TEMPORARY_PREFIX}{secrets.token_hex(8)}"
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, OWNER_ONLY)
    try:
        with os.fdopen(handle, "wb") as file:
            for piece in pieces:
                file.write(piece)
            file.flush()
            os.fsync(handle)
        yield temporary
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise


@contextlib.contextmanager
def _hold_lock(path: str) -> Iterator[None]:
    """Hold a lock on the lock file *path* while the body runs; wait until no other process holds it.

    The body may remove the lock file.
    """
    while True:
        with open(path, "wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            if _is_at(path, file.fileno()):  # otherwise the file was removed while this process waited
                yield
                return


def _is_at(path: str, handle: int) -> bool:
    """Return whether the open file *handle* is the file that is at *path* now."""
    try:
        return os.path.samestat(os.fstat(handle), os.lstat(path))
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def _as_store_errors(name: str) -> Iterator[None]:
    """Convert each OSError of the body to a StoreError about the object *name*."""
    try:
        yield
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
        raise NotFound(f"no object named {name!r}") from error
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise NotFound(f"no object named {name!r}") from error
        if is_full(error):
            raise StoreFull(f"no space left for {name!r}", hint="free some space") from error
        raise StoreError(f"{name!r}: {error.strerror}", hint="check the folder of the store") from error
