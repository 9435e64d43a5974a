"""Reserve disk space with a file, so that an operator can still revoke a robot when the disk is full.

The file, called the reserve, has allocated blocks, and its content is not used.  When the disk is full, a
writer shrinks the reserve by the size of the data to write, then writes as usual: to a temporary file that
replaces the old one.  If another program takes the freed blocks first, the writer shrinks the reserve again.
When too little of the reserve is left, the write fails and the old file stays as it was.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

from rse_pf.storage.files import OWNER_ONLY

__all__ = ["RESERVE_BYTES", "DiskReserve", "is_full"]

# Size in bytes of a full reserve, in addition to the size of the files that it protects: enough for 256
# changes of a short deny list, or 128 if other programs take half of the freed blocks.
RESERVE_BYTES = 4 << 20
# Bytes by which the reserve shrinks in addition to the size of the written file: blocks for the folder and
# for the lock file.
_EXTRA_BYTES = 16 << 10


def is_full(error: OSError) -> bool:
    """Return whether *error* means that the disk, or the user's quota on the disk, is full."""
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


class DiskReserve:
    """The reserve file *path*, which must be on the file system of the files that are to be written."""

    def __init__(self, path: Path) -> None:
        """Store the path; nothing is written yet."""
        self._path = path

    def fill(self, files_bytes: int = 0) -> None:
        """Enlarge the reserve to its full size: `RESERVE_BYTES` and *files_bytes*, the size of the files.

        Raises:
            OSError: The file cannot be written, for example because the disk is full.
        """
        whole = RESERVE_BYTES + files_bytes
        handle = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, OWNER_ONLY)
        try:
            if os.fstat(handle).st_size < whole:
                os.posix_fallocate(handle, 0, whole)
        finally:
            os.close(handle)

    def release(self, size: int) -> bool:
        """Shrink the reserve, so that the disk has free blocks for a file of *size* bytes.

        Returns False, without a change, if the reserve is too small for that or does not exist.
        """
        try:
            left = self._path.stat().st_size - size - _EXTRA_BYTES
            if left >= 0:
                os.truncate(self._path, left)
        except FileNotFoundError:
            return False
        return left >= 0
