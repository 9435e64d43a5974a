"""Write the server's log: one JSON object a line, in a thread of its own.

Lines are collected in memory and written by a thread, so that a slow disk or a full pipe never stops the
event loop; lines that do not fit are counted and dropped.  Payloads and tokens are never logged, and a
hostile string cannot break a line.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from rse_pf.identity import RobotId
from rse_pf.terminal import json_line

__all__ = ["JsonLog"]

_LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40}
_MAX_TEXT = 256
_MAX_TRACEBACK = 8192
_MAX_HELD_LINES = 20_000
_CHUNK_BYTES = 4096
"""A write up to this size does not mix with other writers of the same pipe."""
_FLUSH_S = 0.2

_encode = msgspec.json.Encoder().encode


class JsonLog:
    """The log of one process; its methods only append to a list."""

    def __init__(
        self, *, level: str, server: str, wall_clock: Callable[[], float], fd: int = 2, **about: str
    ) -> None:
        """Write nothing yet; every line gets the fields *about* that it does not set itself."""
        self.dropped = 0
        self._about = {"server": server, **about}
        self._lowest = _LEVELS[level]
        self._wall_clock = wall_clock
        self._fd = fd
        self._lines: deque[bytes] = deque()
        self._wake = threading.Event()
        self._over = False
        self._writer = threading.Thread(target=self._write_on, name="log", daemon=True)

    def start(self) -> JsonLog:
        """Begin to write lines, also those that were logged before this call; return this object."""
        self._writer.start()
        return self

    def writes(self, level: str) -> bool:
        """Whether lines of *level* are written at all."""
        return _LEVELS[level] >= self._lowest

    def debug(self, event: str, **fields: Any) -> None:
        """Log an event that only developers need."""
        self._line("debug", event, fields)

    def info(self, event: str, **fields: Any) -> None:
        """Log an event of normal operation."""
        self._line("info", event, fields)

    def warning(self, event: str, **fields: Any) -> None:
        """Log an event that an operator should look at."""
        self._line("warning", event, fields)

    def error(self, event: str, **fields: Any) -> None:
        """Log a defect."""
        self._line("error", event, fields)

    def close(self, timeout_s: float = 1.0) -> None:
        """Write the remaining lines, for at most *timeout_s* seconds."""
        self._over = True
        self._wake.set()
        self._writer.join(timeout_s)

    def _line(self, level: str, event: str, fields: dict[str, Any]) -> None:
        if _LEVELS[level] < self._lowest:
            return
        if isinstance(fields.get("robot"), RobotId):
            fields["tenant"], fields["robot"], _ = fields["robot"]
        for name, value in fields.items():
            if isinstance(value, str) and len(value) > _MAX_TEXT:
                fields[name] = value[-_MAX_TRACEBACK:] if name == "traceback" else value[:_MAX_TEXT]
        head = {"time": self._wall_clock(), "level": level, "event": event}
        line = json_line({**head, **self._about, **fields}, _encode)
        if len(self._lines) >= _MAX_HELD_LINES:
            self.dropped += 1
            return
        self._lines.append(line)
        if not self._wake.is_set():
            self._wake.set()

    def _write_on(self) -> None:
        pause = threading.Event()
        while not (self._over and not self._lines):
            self._wake.wait()
            if not self._over:
                pause.wait(_FLUSH_S)
            self._wake.clear()
            lines = [self._lines.popleft() for _ in range(len(self._lines))]
            try:
                for chunk in _chunks(lines):
                    os.write(self._fd, chunk)
            except OSError:
                self.dropped += len(lines)


def _chunks(lines: list[bytes]) -> list[bytes]:
    chunks: list[bytes] = []
    current: list[bytes] = []
    size = 0
    for line in lines:
        if current and size + len(line) + 1 > _CHUNK_BYTES:
            chunks.append(b"\n".join(current) + b"\n")
            current, size = [], 0
        current.append(line)
        size += len(line) + 1
    return [*chunks, b"\n".join(current) + b"\n"] if current else chunks
