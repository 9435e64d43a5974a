"""Weak and failed commands as they come, from the logs that the servers of a local platform write anyway.

Only the lines about commands are read.  The text in them may come from robots: it is escaped here.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rse_pf.extensions.fleet_page.feeds.file_tail import FileTail
from rse_pf.terminal import printable

__all__ = ["CommandLog"]

_MARK = b'"command"'
_FIELDS = (
    "robot", "service", "id", "trace", "code", "verdict", "reason", "queue_ms", "compute_ms", "bytes_in",
    "server",
)  # fmt: skip
_MAX_TEXT = 200
_MAX_ROWS = 200


class CommandLog:
    """Reads what is appended to the logs of a folder, and first the end of what is there."""

    def __init__(self, folder: Path) -> None:
        """Read nothing yet."""
        self._folder = folder
        self._tail = FileTail()
        self.skipped = 0
        """Lines that came faster than they are shown."""

    def new_rows(self) -> list[dict[str, Any]]:
        """Return the commands that were written since the last call, oldest first."""
        rows: list[dict[str, Any]] = []
        for file in sorted(self._folder.glob("server-*.log")):
            rows += self._rows_of(file)
        rows.sort(key=lambda row: float(row["time_s"]))
        self.skipped += max(len(rows) - _MAX_ROWS, 0)
        return rows[-_MAX_ROWS:]

    def _rows_of(self, file: Path) -> list[dict[str, Any]]:
        lines = self._tail.new_lines(file)
        return [row for row in map(_row, lines) if row is not None]


def _row(line: bytes) -> dict[str, Any] | None:
    """Return what is shown of one line; None if it tells of no weak or failed command."""
    if _MARK not in line:
        return None
    try:
        fields = json.loads(line)
    except ValueError:
        return None
    if not isinstance(fields, dict) or fields.get("event") != "command":
        return None
    row: dict[str, Any] = {name: fields[name] for name in _FIELDS if name in fields}
    if row.get("code") in ("busy", "stale") or (row.get("code") == "ok" and row.get("verdict") != "weak"):
        return None
    time_s = fields.get("time", 0.0)
    row["time_s"] = time_s if isinstance(time_s, int | float) else 0.0
    return {
        name: value if isinstance(value, int | float) else printable(str(value)[:_MAX_TEXT])
        for name, value in row.items()
    }
