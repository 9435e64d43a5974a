"""Read new weak and failed commands from the logs of a local platform's servers.

Only the lines about commands are parsed.  Texts in them may come from robots, and are escaped here.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rse_pf.extensions.fleet_page.feeds.file_tail import FileTail
from rse_pf.terminal import printable

__all__ = ["CommandLog"]

# Lines without these bytes are about other events, and are not parsed.
_COMMAND_MARK = b'"command"'
# Members of a line that are shown.
_SHOWN_FIELDS = (
    "robot", "service", "id", "trace", "code", "verdict", "reason", "queue_ms", "compute_ms", "bytes_in",
    "server",
)  # fmt: skip
# Largest number of characters of a text.
_MAX_TEXT = 200
# Largest number of commands that are shown after one reading; of more, the newest are shown.
_MAX_ROWS = 200


class CommandLog:
    """Reads the logs of the servers in a folder: at first their last lines, then what is appended."""

    def __init__(self, folder: Path) -> None:
        """Prepare to read the logs in *folder*; nothing is read yet."""
        self._folder = folder
        self._tail = FileTail()
        self.skipped = 0
        """Number of commands that were not shown, because one reading found more than 200."""

    def new_rows(self) -> list[dict[str, Any]]:
        """Return the weak and failed commands that were logged since the last call, oldest first."""
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
    """Return the row of the Poses view for a log line.

    None if the line is not about a weak or failed command.  Commands with the codes busy and stale are no
    failures here.
    """
    if _COMMAND_MARK not in line:
        return None
    try:
        fields = json.loads(line)
    except ValueError:
        return None
    if not isinstance(fields, dict) or fields.get("event") != "command":
        return None
    row: dict[str, Any] = {name: fields[name] for name in _SHOWN_FIELDS if name in fields}
    if row.get("code") in ("busy", "stale") or (row.get("code") == "ok" and row.get("verdict") != "weak"):
        return None
    time_s = fields.get("time", 0.0)
    row["time_s"] = time_s if isinstance(time_s, int | float) else 0.0
    return {
        name: value if isinstance(value, int | float) else printable(str(value)[:_MAX_TEXT])
        for name, value in row.items()
    }
