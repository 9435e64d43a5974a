"""Blocks of a disk that are taken before they are needed, so that a full disk does not stop what protects it.

A file that is appended to takes blocks beyond its end (`preallocate`).  A small file that is replaced as a
whole exchanges its place with one of some spare files (`SpareFiles`).  No block is ever given back to the
disk in between, where another program could take it.  File systems without fallocate(2) have no reserve.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import fcntl
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from rse_pf.files import OWNER_ONLY, TEMPORARY_PREFIX, sync_folder

__all__ = ["SPARE_BYTES", "SPARE_FILES", "SpareFiles", "allocated_bytes", "is_full", "preallocate"]

SPARE_FILES = 4
"""Two more than the files that exchange with them: then a large spare is always left."""
SPARE_BYTES = 256 << 10
_SPARE = "spare-"
_BLOCK_BYTES = 512
"""Unit of ``st_blocks``, whatever the file system."""
_KEEP_SIZE, _EXCHANGE, _HERE = 1, 2, -100
_LIBC = ctypes.CDLL(None, use_errno=True)


def is_full(error: OSError) -> bool:
    """Return whether *error* says that the disk, or the user's share of it, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def allocated_bytes(fd: int) -> int:
    """Return for how many bytes the open file has blocks, also beyond its end; raises OSError."""
    return os.fstat(fd).st_blocks * _BLOCK_BYTES


def preallocate(fd: int, end: int) -> None:
    """Take blocks for a file without holes up to *end*; its size stays, and no write before *end* fails.

    Raises:
        OSError: The disk is full, or the file system cannot do this; the blocks before stay.
    """
    begin = allocated_bytes(fd)  # tmpfs gives back what an earlier call took if a call over it fails
    if begin < end:
        length = ctypes.c_int64(end - begin)
        _check(_LIBC.fallocate(fd, _KEEP_SIZE, ctypes.c_int64(begin), length))


class SpareFiles:
    """A few files with blocks of their own, of which one can take the place of another file of a full disk.

    Content is text that may end with spaces, such as JSON: a spare never becomes shorter, which would give
    its blocks back.  Any number of processes may use one folder.
    """

    def __init__(self, folder: Path) -> None:
        """Describe them; *folder* is on the file system of the files that are replaced."""
        self._folder = folder

    def refill(self, size: int = SPARE_BYTES) -> None:
        """Make every spare that is missing or holds less than *size* bytes anew.

        Raises:
            OSError: The disk is full, or the file system cannot preallocate; the earlier spares stay.
        """
        self._folder.mkdir(mode=0o700, exist_ok=True)
        with self._hold_lock():
            for number in range(SPARE_FILES):
                spare = self._folder / f"{_SPARE}{number}"
                if _allocated(spare) < size:
                    self._make(spare, size)

    def replace(self, path: Path, text: bytes) -> None:
        """Replace *path* by a spare file with *text* and perhaps spaces after it, in one step and durably.

        Without a spare that is large enough, *path* is overwritten in the blocks that it has, which is not
        one step: a reader may find a part of the text, and has to read again.

        Raises:
            OSError: The text is longer than these blocks, too; *path* is as it was.
        """
        with self._hold_lock():
            spare = max(self._folder.glob(f"{_SPARE}*"), key=_allocated, default=path)
            if _allocated(spare) < len(text):
                spare = path
            if _allocated(spare) < len(text):
                raise OSError(errno.ENOSPC, "no space left, and none in the reserve")
            _overwrite(spare, text)
            if spare != path:
                _exchange(spare, path)
        sync_folder(path.parent)

    @contextlib.contextmanager
    def _hold_lock(self) -> Iterator[None]:
        try:
            handle = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:  # there never was a reserve: other writers hold the caller's lock
            yield
            return
        try:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)

    def _make(self, spare: Path, size: int) -> None:
        for temporary_left in self._folder.glob(f"{TEMPORARY_PREFIX}*"):
            temporary_left.unlink()
        temporary = self._folder / f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}"
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, OWNER_ONLY)
        try:
            preallocate(handle, size)
            os.replace(temporary, spare)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        finally:
            os.close(handle)


def _allocated(path: Path) -> int:
    """Return for how many bytes *path* has blocks, 0 if it is missing."""
    try:
        return path.stat().st_blocks * _BLOCK_BYTES
    except FileNotFoundError:
        return 0


def _overwrite(path: Path, text: bytes) -> None:
    """Write *text* over the content of *path*, and spaces over what is left of it."""
    with path.open("r+b", buffering=0) as file:
        content = memoryview(text.ljust(os.fstat(file.fileno()).st_size))
        while content:
            content = content[file.write(content) :]
        os.fsync(file.fileno())


def _exchange(spare: Path, path: Path) -> None:
    """Exchange the names of the two files in one step; a missing *path* leaves one spare less."""
    result = _LIBC.renameat2(_HERE, os.fsencode(spare), _HERE, os.fsencode(path), _EXCHANGE)
    if result and ctypes.get_errno() == errno.ENOENT:
        os.replace(spare, path)
    else:
        _check(result)


def _check(result: int) -> None:
    if result:
        code = ctypes.get_errno()
        raise OSError(code, os.strerror(code))
