"""The control plane's own audit log: what it started, stopped and moved.

Every event of the platform becomes an entry.  A log that cannot be written neither delays nor ends the
platform.
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
    """Records events of one control plane in its audit log; drops those before `open` and after `close`."""

    def __init__(self, state: Path, *, on_problem: Callable[[str], None]) -> None:
        """Open nothing yet; *on_problem* is called as `AuditLog` says."""
        self._is_open = False
        self._log = AuditLog(audit_folder(state), CONTROL_PLANE, wall_clock=time.time, on_problem=on_problem)

    def open(self) -> None:
        """Begin to record; raises ConfigurationError."""
        self._log.open().start()
        self._is_open = True

    def record(self, event: Mapping[str, Any]) -> None:
        """Record one event of the platform."""
        if self._is_open:
            detail = {name: _value(value) for name, value in event.items() if name not in ("event", "server")}
            action, subject = f"platform.{event['event']}", str(event.get("server", ""))
            self._log.record(action, subject, **detail)

    def close(self) -> None:
        """Record the end."""
        if self._is_open:
            self._is_open = False
            self._log.record("platform.over")
            self._log.close()


def _value(value: Any) -> Value:
    if isinstance(value, list | tuple):
        return ",".join(map(str, value))
    return value if value is None or isinstance(value, str | int | float) else str(value)
