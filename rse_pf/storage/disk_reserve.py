"""Reserve disk space with a file, so that an operator can still revoke a robot when the disk is full.

The file has allocated blocks and no content that matters.  When the disk is full, a writer shrinks the file
by the size of what it writes, then writes as usual: to a temporary file that replaces the old one.  If
another program takes the blocks first, the writer shrinks the file again.  When too little is left, the
write fails and the old file stays as it was.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

from rse_pf.storage.files import OWNER_ONLY

__all__ = ["RESERVE_BYTES", "DiskReserve", "is_full"]

# Size of a whole reserve beyond that of its files: 256 changes of a short deny list, 128 if others take half.
RESERVE_BYTES = 4 << 20
# The reserve shrinks by at least this much beyond the content: blocks of the folder and of the lock file.
_EXTRA_BYTES = 16 << 10


def is_full(error: OSError) -> bool:
    """Return whether *error* says that the disk, or the user's quota on it, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


class DiskReserve:
    """The reserve at one path, on the file system of the files that are to be written."""

    def __init__(self, path: Path) -> None:
        """Describe the reserve; nothing is written."""
        self._path = path

    def fill(self, files_bytes: int = 0) -> None:
        """Make the reserve whole again, for files of *files_bytes*; raises OSError, also on a full disk."""
        whole = RESERVE_BYTES + files_bytes
        handle = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, OWNER_ONLY)
        try:
            if os.fstat(handle).st_size < whole:
                os.posix_fallocate(handle, 0, whole)
        finally:
            os.close(handle)

    def release(self, size: int) -> bool:
        """Give the blocks for a file of *size* bytes back to the disk; return False if too few are left."""
        try:
            left = self._path.stat().st_size - size - _EXTRA_BYTES
            if left >= 0:
                os.truncate(self._path, left)
        except FileNotFoundError:
            return False
        return left >= 0
