"""The control plane's own audit log: what it started, stopped and moved, and the heads of the other logs.

Every event of the platform becomes an entry.  The heads of the other chains become entries, too, which shows
if the end of one of them is removed; the control plane's last head is recorded in the log of operators.  A
log that cannot be written neither delays nor ends the platform.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rse_pf.audit.chain import HEADS, Note, Value
from rse_pf.audit.log import (
    CONTROL_PLANE,
    HEADS_S,
    OPERATOR,
    AuditLog,
    audit_folder,
    chain_names,
    grown_heads,
    record_once,
    release_reserves,
)
from rse_pf.errors import ConfigurationError

__all__ = ["PlatformAudit"]

_MAX_HEADS = 50
"""In one entry."""
_WAIT_S = 2.0


class PlatformAudit:
    """The log of one control plane, between `open` and `close`."""

    def __init__(self, state: Path, heads_s: float = HEADS_S) -> None:
        self.folder = audit_folder(state)
        self._heads_s = heads_s
        self._is_open = False
        self._recorded: dict[str, str] = {}
        self._log = AuditLog(self.folder, CONTROL_PLANE, wall_clock=time.time)

    def open(self) -> None:
        """Begin to record; raises ConfigurationError."""
        self._log.open(_WAIT_S).start()
        self._is_open = True
        with contextlib.suppress(ConfigurationError):  # a command of an operator is just writing it
            AuditLog(self.folder, OPERATOR, wall_clock=time.time).open().close()  # takes its reserve

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
        """Record the heads of the other chains that have grown; take the space of killed writers."""
        release_reserves(self.folder)
        others = [who for who in chain_names(self.folder) if who != CONTROL_PLANE]
        grown = grown_heads(self.folder, others, self._recorded)
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
            head = {CONTROL_PLANE: str(self._log.head)}
            with contextlib.suppress(ConfigurationError):  # the next start records it
                record_once(self.folder, OPERATOR, HEADS, wall_clock=time.time, **head)

    def _add(self, action: str, subject: str, detail: Mapping[str, Value]) -> None:
        self._log.add(
            [Note(time=time.time(), actor=CONTROL_PLANE, action=action, subject=subject, detail=detail)]
        )


def _value(value: Any) -> Value:
    if isinstance(value, list | tuple):
        return ",".join(map(str, value))
    return value if value is None or isinstance(value, str | int | float) else str(value)
