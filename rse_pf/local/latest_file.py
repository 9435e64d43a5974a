"""A small file that follows what its owner knows, also over a time in which the disk takes nothing.

The file of the platform's processes and the balancer's lists of servers change while the platform runs.  If
the disk is full at that moment, the newest content is written as soon as there is space, and the work that
changed it goes on.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

from rse_pf.files import replace_file

__all__ = ["RETRY_S", "LatestFile"]

RETRY_S = 1.0
"""Time between two attempts to write a file."""


class LatestFile:
    """One such file; a failure of its first write is the caller's, later ones are retried."""

    def __init__(
        self,
        path: Path,
        *,
        on_problem: Callable[[str], None] = lambda problem: None,
        retry_s: float = RETRY_S,
    ) -> None:
        """Describe the file; nothing is written.

        Args:
            path: Of the file; its folder exists.
            on_problem: Called with a sentence when a write has failed, once until the next success.
            retry_s: Time between two attempts.
        """
        self._path = path
        self.on_problem = on_problem
        self._retry_s = retry_s
        self._text = ""
        self._was_written = False
        self._retry: asyncio.TimerHandle | None = None

    def write(self, text: str) -> None:
        """Replace the file by *text* in one step, now or as soon as the disk allows.

        Raises:
            OSError: The file was never written, and cannot be now.
        """
        self._text = text
        if self._was_written:
            self._try()
        else:
            replace_file(self._path, text)
            self._was_written = True

    def close(self) -> None:
        """Give up what is not written."""
        if self._retry is not None:
            self._retry.cancel()
        self._retry = None

    def _try(self) -> None:
        is_first = self._retry is None
        self.close()
        try:
            replace_file(self._path, self._text)
        except OSError as error:
            self._retry = asyncio.get_running_loop().call_later(self._retry_s, self._try)
            if is_first:
                self.on_problem(f"{self._path.name} cannot be written yet: {error.strerror}")
