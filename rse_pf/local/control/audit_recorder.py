"""The control plane's own audit log: what it started, stopped and moved, and the heads of the other logs.

Every event of the platform becomes an entry.  The heads of the other chains become entries, too, which shows
if the end of one of them is removed.  A log that cannot be written neither delays nor ends the platform.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rse_pf.audit.chain import HEADS, Note, Value
from rse_pf.audit.log import AuditLog, audit_folder, chain_names, newest_head

__all__ = ["PlatformAudit"]

_WHO = "control-plane"
_MAX_HEADS = 50
"""In one entry."""
_WAIT_S = 2.0
HEADS_S = 60.0
"""Time between two looks at the heads of the other audit logs."""


class PlatformAudit:
    """The log of one control plane, between `open` and `close`."""

    def __init__(self, state: Path, heads_s: float = HEADS_S) -> None:
        self.folder = audit_folder(state)
        self._heads_s = heads_s
        self._is_open = False
        self._recorded: dict[str, str] = {}
        self._log = AuditLog(self.folder, _WHO, wall_clock=time.time)

    def open(self) -> None:
        """Begin to record; raises ConfigurationError."""
        self._log.open(_WAIT_S).start()
        self._is_open = True

    def record(self, event: Mapping[str, Any]) -> None:
        """Record one event of the platform."""
        if self._is_open:
            detail = {name: _value(value) for name, value in event.items() if name not in ("event", "server")}
            subject = str(event.get("server", ""))
            self._add(f"platform.{event['event']}", subject, detail)

    async def watch(self) -> None:
        """Record the heads of the other chains periodically, until cancelled."""
        while True:
            await asyncio.sleep(self._heads_s)
            await asyncio.to_thread(self.record_heads)

    def record_heads(self) -> None:
        """Record the heads of the other chains that have grown."""
        grown: dict[str, Value] = {}
        for who in chain_names(self.folder):
            head = None if who == _WHO else newest_head(self.folder, who)
            if head is not None and self._recorded.get(who) != str(head):
                grown[who] = self._recorded[who] = str(head)
        names = list(grown)
        for first in range(0, len(names), _MAX_HEADS):
            some = names[first : first + _MAX_HEADS]
            self._add(HEADS, "", {name: grown[name] for name in some})

    def close(self) -> None:
        """Record the last heads and the end."""
        if self._is_open:
            self._is_open = False
            self.record_heads()
            self._add("platform.over", "", {})
            self._log.close()

    def _add(self, action: str, subject: str, detail: Mapping[str, Value]) -> None:
        self._log.add([Note(time=time.time(), actor=_WHO, action=action, subject=subject, detail=detail)])


def _value(value: Any) -> Value:
    if isinstance(value, list | tuple):
        return ",".join(map(str, value))
    return value if value is None or isinstance(value, str | int | float) else str(value)
