"""Keep one server process warm: importing is most of a server's start, and comes at the worst moment.

A replacement is wanted when a server has died and its neighbour works for two.  Promises that a spare never
outlives the platform, and that a launch without one works just the same, only later.

Source:
    Warm pools of AWS Auto Scaling.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rse_pf.local.processes import spawn

__all__ = ["SPARE", "WarmStandby"]

SPARE = (sys.executable, "-m", "rse_pf.cli.standby")
"""The program; it waits for its arguments."""


class WarmStandby:
    """At most one process that waits for its turn."""

    def __init__(self, folder: Path, *, dies_with_parent: bool, program: Sequence[str] = SPARE) -> None:
        self._folder = folder
        self._dies_with_parent = dies_with_parent
        self._program = tuple(program)
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int | None:
        """Of the process that waits, if there is one."""
        return None if self._process is None or self._process.poll() is not None else self._process.pid

    @property
    def is_warm(self) -> bool:
        """Whether the one that waits has said so."""
        with contextlib.suppress(OSError):
            return self.pid is not None and self._log.stat().st_size > 0
        return False

    @property
    def _log(self) -> Path:
        return self._folder / "spare.log"

    def warm(self) -> bool:
        """Start one, unless one waits already; return whether one was started."""
        waits = self.pid is not None
        if not waits:
            self.close()
            self._process = spawn(
                self._program, log=self._log, folder=self._folder,
                dies_with_parent=self._dies_with_parent, stdin=subprocess.PIPE,
            )  # fmt: skip
        return not waits

    def take(self, arguments: Sequence[str], log: Path) -> subprocess.Popen[bytes] | None:
        """Let the one that waits go on with *arguments* and write to *log*; None if there is none."""
        process = self._process if self.pid is not None else None
        if process is None or process.stdin is None:
            return None
        order = json.dumps({"arguments": list(arguments), "log": str(log.absolute())})
        try:
            process.stdin.write(order.encode() + b"\n")
            process.stdin.close()
        except OSError:  # it died this moment
            self.close()
            return None
        self._process = None
        return process

    def close(self) -> None:
        """End the one that waits, if any, and reap it."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            if process.stdin is not None:
                with contextlib.suppress(OSError):
                    process.stdin.close()
