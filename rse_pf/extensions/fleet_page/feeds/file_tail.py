"""Read the lines that other processes append to files, also if a file is renamed, replaced or truncated.

A file is identified by its inode, so that a renamed file is read to its end.  Lines are not parsed.
"""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["FileTail"]

# Largest number of bytes that one call reads of a file; of more new bytes, only the last ones are read.
_MAX_READ_BYTES = 1 << 20
# Number of bytes at the end of a file that the first call reads, and largest part of a line that is stored.
_TAIL_BYTES = 1 << 18
# Largest number of files whose positions are stored.
_MAX_FILES = 1024


class FileTail:
    """Reads files: at first their last lines, then what is appended."""

    def __init__(self) -> None:
        """Start without files."""
        self._read: dict[tuple[int, int], int] = {}
        self._rest: dict[tuple[int, int], bytes] = {}

    def new_lines(self, file: Path) -> list[bytes]:
        """Return the complete lines of *file* since the last call, without line breaks.

        At the first call these are the lines in its last 256 KiB.  If more than 1 MiB was written since, only
        the last MiB is read.  The result is empty if the file cannot be read.
        """
        try:
            status = file.stat()
            key, size = (status.st_dev, status.st_ino), status.st_size
            position = self._read.get(key)
            start = max(0, size - _TAIL_BYTES) if position is None else position
            if size < start:  # the file was truncated
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
        while len(self._read) > _MAX_FILES:  # the oldest entries are mostly of deleted files
            self._rest.pop(oldest := next(iter(self._read)), None)
            del self._read[oldest]
        return lines[1:] if is_cut else lines


def _part(file: Path, key: tuple[int, int], start: int, count: int) -> bytes:
    """Return *count* bytes of *file* from *start*.

    Raises OSError if its name now belongs to another inode.
    """
    with file.open("rb") as opened:
        status = os.fstat(opened.fileno())
        if (status.st_dev, status.st_ino) != key:
            raise FileNotFoundError(file)
        opened.seek(start)
        return opened.read(count)
