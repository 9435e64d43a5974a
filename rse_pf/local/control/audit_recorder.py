"""The audit log of the control plane of a local platform: what it started, stopped and moved.

Every event of the platform becomes an entry.  If the log cannot be written, the platform runs on undelayed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from rse_pf.audit.entry import Value
from rse_pf.audit.log import CONTROL_PLANE, AuditLog, audit_folder

__all__ = ["PlatformAudit"]


class PlatformAudit:
    """The audit log of one control plane; events before `open` and after `close` are not recorded."""

    def __init__(self, state: Path, *, on_problem: Callable[[str], None]) -> None:
        """Describe the log in the folder *state*; nothing is opened yet.

        *on_problem* is called with a sentence, in any thread, when writing begins to fail, and when `close`
        loses entries.
        """
        self._is_open = False
        self._log = AuditLog(audit_folder(state), CONTROL_PLANE, wall_clock=time.time, on_problem=on_problem)

    def open(self) -> None:
        """Begin to record; raises ConfigurationError if the log cannot be written."""
        self._log.open().start()
        self._is_open = True

    def record(self, event: Mapping[str, Any]) -> None:
        """Record one event of the platform as the action ``platform.EVENT`` on its server."""
        if self._is_open:
            detail = {name: _value(value) for name, value in event.items() if name not in ("event", "server")}
            action, subject = f"platform.{event['event']}", str(event.get("server", ""))
            self._log.record(action, subject, **detail)

    def close(self) -> None:
        """Record that the platform has ended, and close the log."""
        if self._is_open:
            self._is_open = False
            self._log.record("platform.over")
            self._log.close()


def _value(value: Any) -> Value:
    """Return *value* as an entry may hold it: a list becomes words with commas, other objects become text."""
    if isinstance(value, list | tuple):
        return ",".join(map(str, value))
    return value if value is None or isinstance(value, str | int | float) else str(value)
