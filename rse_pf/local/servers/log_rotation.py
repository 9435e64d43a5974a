"""Rotate the logs of a local platform, so that they do not fill the disk.

The newest lines stay, in the log or in its one predecessor ``NAME.log.1``.  The process that writes to the
log is not disturbed.

Source:
    copytruncate of logrotate(8): the writer, which only appends, keeps its descriptor.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
from pathlib import Path

__all__ = ["rotate_logs", "rotate_long_logs"]

_EVERY_S = 5.0


async def rotate_logs(folder: Path, max_bytes: int) -> None:
    """Rotate the logs of *folder* periodically, until cancelled."""
    while True:
        await asyncio.to_thread(rotate_long_logs, folder, max_bytes)
        await asyncio.sleep(_EVERY_S)


def rotate_long_logs(folder: Path, max_bytes: int) -> list[Path]:
    """Rotate every ``*.log`` of *folder* that is longer than *max_bytes*; return those logs.

    A line that is written between the copy and the cut is lost.
    """
    longer: list[Path] = []
    for log in sorted(folder.glob("*.log")):
        with contextlib.suppress(OSError):  # it is gone, or the disk is full: try again next time
            if log.stat().st_size > max_bytes:
                copy = log.with_name(f"{log.name}.1")
                shutil.copyfile(log, copy)
                copy.chmod(log.stat().st_mode)
                os.truncate(log, 0)
                longer.append(log)
    return longer
