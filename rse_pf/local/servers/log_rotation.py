"""Keep the logs of a local platform from filling the disk: what has grown too long begins anew.

Promises that the newest lines stay, in the file or in its one predecessor ``NAME.log.1``, and that a process
which writes to the log notices nothing.

Source:
    copytruncate of logrotate(8): the writer, which only appends, keeps its descriptor.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
from pathlib import Path

__all__ = ["keep_short", "turn_over"]

_LOOK_EVERY_S = 5.0


async def keep_short(folder: Path, max_bytes: int) -> None:
    """Look at the logs of *folder* again and again, until cancelled."""
    while True:
        await asyncio.to_thread(turn_over, folder, max_bytes)
        await asyncio.sleep(_LOOK_EVERY_S)


def turn_over(folder: Path, max_bytes: int) -> list[Path]:
    """Let every ``*.log`` of *folder* that is longer than *max_bytes* begin anew; return those logs.

    A line that is written between the copy and the cut is lost.
    """
    longer: list[Path] = []
    for log in sorted(folder.glob("*.log")):
        with contextlib.suppress(OSError):  # it went away, or there is no room for a copy: the next look
            if log.stat().st_size > max_bytes:
                copy = log.with_name(f"{log.name}.1")
                shutil.copyfile(log, copy)
                copy.chmod(log.stat().st_mode)
                os.truncate(log, 0)
                longer.append(log)
    return longer
