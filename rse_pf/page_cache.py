"""The page cache: read a file if that never waits for a disk, and begin to write what will be synced.

What cannot be read so is left to a thread.

Source:
    openat2(2), RESOLVE_CACHED; preadv2(2), RWF_NOWAIT; sync_file_range(2).
"""

from __future__ import annotations

import ctypes
import os
import stat

__all__ = ["read_cached", "start_writing"]

_OPENAT2, _AT_FDCWD, _RESOLVE_CACHED = 437, -100, 0x20
_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK


class _How(ctypes.Structure):
    _fields_ = (("flags", ctypes.c_uint64), ("mode", ctypes.c_uint64), ("resolve", ctypes.c_uint64))


_HOW = _How(_FLAGS, 0, _RESOLVE_CACHED)
_SIZE = ctypes.c_size_t(ctypes.sizeof(_How))
# PyDLL keeps the interpreter's lock: these calls never wait, and giving it away would take longer.
_syscall = ctypes.PyDLL(None).syscall
_syscall.restype = ctypes.c_long
_syscall.argtypes = (ctypes.c_long, ctypes.c_int, ctypes.c_char_p, ctypes.c_void_p, ctypes.c_size_t)

_sync_file_range = ctypes.CDLL(None).sync_file_range
_sync_file_range.argtypes = (ctypes.c_int, ctypes.c_int64, ctypes.c_int64, ctypes.c_uint)
_WRITE = 2  # SYNC_FILE_RANGE_WRITE


def read_cached(path: str, start: int, length: int) -> tuple[int, bytes] | None:
    """Return the size of the file at *path*, which is no link, and at most *length* bytes from *start* on.

    None if it may be absent or not in memory, or where the kernel or the file system cannot answer without
    waiting.
    """
    descriptor = _syscall(_OPENAT2, _AT_FDCWD, path.encode(), ctypes.byref(_HOW), _SIZE)
    if descriptor < 0:
        return None
    try:
        status = os.fstat(descriptor)
        count = max(0, min(length, status.st_size - start))
        if not stat.S_ISREG(status.st_mode):
            return None
        data = bytearray(count)
        got = os.preadv(descriptor, [data], start, os.RWF_NOWAIT) if count else 0
        return (status.st_size, bytes(data)) if got == count else None
    except OSError:  # a part is not in memory, or the file system does not know
        return None
    finally:
        os.close(descriptor)


def start_writing(descriptor: int, start: int, length: int) -> None:
    """Let the kernel begin to write a part of a file to the disk, so that a later sync waits for less."""
    _sync_file_range(descriptor, start, length, _WRITE)
