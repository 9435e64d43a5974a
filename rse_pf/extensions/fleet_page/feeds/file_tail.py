"""New lines of files that other processes write, whatever happens to these: renamed, set aside, begun anew.

A file is known by its inode, so that it is read to its end after it was renamed.  Nothing is interpreted.
"""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["FileTail"]

_MAX_READ_BYTES = 1 << 20
_TAIL_BYTES = 1 << 18
_MAX_FILES = 1024


class FileTail:
    """Reads what is appended to files, and first the end of what is there."""

    def __init__(self) -> None:
        """Read nothing yet."""
        self._read: dict[tuple[int, int], int] = {}
        self._rest: dict[tuple[int, int], bytes] = {}

    def new_lines(self, file: Path) -> list[bytes]:
        """Return the whole lines of *file* since the last call, without line breaks; none if it is gone.

        At most 1 MiB is read at once: what was written before it is skipped.
        """
        try:
            status = file.stat()
            key, size = (status.st_dev, status.st_ino), status.st_size
            position = self._read.get(key)
            start = max(0, size - _TAIL_BYTES) if position is None else position
            if size < start:  # it was begun anew
                start, self._rest[key] = 0, b""
            is_cut = position is None and start > 0
            if size - start > _MAX_READ_BYTES:
                start, self._rest[key], is_cut = size - _MAX_READ_BYTES, b"", True
            data = _part(file, key, start, size - start) if size > start else b""
        except OSError:
            return []
        self._read[key] = start + len(data)
        *lines, self._rest[key] = (self._rest.get(key, b"") + data).split(b"\n")
        self._rest[key] = self._rest[key][-_TAIL_BYTES:]
        while len(self._read) > _MAX_FILES:  # most of them were deleted long ago
            self._rest.pop(oldest := next(iter(self._read)), None)
            del self._read[oldest]
        return lines[1:] if is_cut else lines


def _part(file: Path, key: tuple[int, int], start: int, count: int) -> bytes:
    """Return *count* bytes of *file*; raises OSError if another file has its name by now."""
    with file.open("rb") as opened:
        status = os.fstat(opened.fileno())
        if (status.st_dev, status.st_ino) != key:
            raise FileNotFoundError(file)
        opened.seek(start)
        return opened.read(count)
