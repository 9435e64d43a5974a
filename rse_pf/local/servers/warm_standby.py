"""Keep one process that has imported everything a backend server needs, for the next launch.

The imports take most of the time that a server needs to start, and when a server has failed, the others do
its work until its replacement serves.  Without a standby a launch only takes longer.  The standby is killed
when the platform stops.

Source:
    Warm pools of AWS Auto Scaling.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rse_pf.local.processes import log_size, spawn

__all__ = ["STANDBY", "WarmStandby"]

# Time between two checks whether the standby is warm, in seconds.
_POLL_S = 0.01
STANDBY = (sys.executable, "-m", "rse_pf.cli.servers.standby")
"""The command of a standby process; it reads the arguments of the server from standard input."""


class WarmStandby:
    """At most one standby process; none is ever started if *program* is empty."""

    def __init__(self, folder: Path, *, dies_with_parent: bool, program: Sequence[str] = STANDBY) -> None:
        self._folder = folder
        self._dies_with_parent = dies_with_parent
        self._program = tuple(program)
        self._process: subprocess.Popen[bytes] | None = None
        self._log_from = 0

    @property
    def pid(self) -> int | None:
        """The id of the standby process; None if there is none."""
        return None if self._process is None or self._process.poll() is not None else self._process.pid

    @property
    def is_warm(self) -> bool:
        """Whether there is a standby that has imported everything: it has then written a line to its log."""
        return self.pid is not None and log_size(self._log) > self._log_from

    @property
    def _log(self) -> Path:
        return self._folder / "standby.log"

    def warm(self) -> bool:
        """Start a standby unless there is one; return whether one was started.  Does not wait for it."""
        if self.pid is not None or not self._program:
            return False
        self.close()
        self._log_from = log_size(self._log)
        self._process = spawn(
            self._program, log=self._log, folder=self._folder,
            dies_with_parent=self._dies_with_parent, stdin=subprocess.PIPE,
        )  # fmt: skip
        return True

    async def wait_warm(self, timeout_s: float) -> None:
        """Start a standby unless there is one, and wait until it is warm, but not longer than *timeout_s*."""
        end = time.monotonic() + timeout_s
        self.warm()
        while self._program and not self.is_warm and time.monotonic() < end:
            await asyncio.sleep(_POLL_S)

    def take(self, arguments: Sequence[str], log: Path) -> subprocess.Popen[bytes] | None:
        """Make the standby a server: it runs rse-pf with *arguments*, and writes to *log* from now on.

        Returns its process, which is no standby any more; None if there is no standby.
        """
        process = self._process if self.pid is not None else None
        if process is None or process.stdin is None:
            return None
        order = json.dumps({"arguments": list(arguments), "log": str(log.absolute())})
        try:
            process.stdin.write(order.encode() + b"\n")
            process.stdin.close()
        except OSError:  # the standby has just exited
            self.close()
            return None
        self._process = None
        return process

    def close(self) -> None:
        """Kill the standby, if there is one, and reap it."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            if process.stdin is not None:
                with contextlib.suppress(OSError):
                    process.stdin.close()
