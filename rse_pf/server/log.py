"""Write the log of a server process: one JSON object a line.

Log calls append lines to a queue in memory, and a thread writes them, so that a slow disk or a full pipe
never stops the event loop.  Lines beyond `_MAX_HELD_LINES` in the queue are dropped and counted.  Control
characters in strings are escaped, so that a string of a robot cannot break a line.  Callers never pass
payloads or tokens.
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

_LEVELS = {"debug": 10, "info": 20, "warning": 30, "error": 40}  # severity: a greater number is more severe
_MAX_TEXT = 256  # characters of a string field; the rest is cut off, since robots choose some of the strings
_MAX_TRACEBACK = 8192  # characters of the field ``traceback``: its end is kept, which names the exception
_MAX_HELD_LINES = 20_000  # lines that wait to be written; further ones are dropped, so that memory is bounded
_CHUNK_BYTES = 4096  # bytes of one write: PIPE_BUF of Linux, up to which writes to a shared pipe do not mix
_FLUSH_S = 0.2  # the writer collects lines for this many seconds, so that many lines cost one system call

_encode = msgspec.json.Encoder().encode


class JsonLog:
    """The log of one process; logging appends a line to a queue and never blocks.

    ``dropped`` counts the lines that were lost, because the queue was full or writing failed.
    """

    def __init__(
        self, *, level: str, server: str, wall_clock: Callable[[], float], fd: int = 2, **about: str
    ) -> None:
        """Write nothing before `start`.

        Args:
            level: Lines below this level are left out: debug, info, warning or error.
            server: Name of the server, a field of every line.
            wall_clock: Returns Unix seconds, the field ``time`` of every line.
            fd: The descriptor to which lines are written; 2 is standard error.
            **about: Further fields of every line; a log call may set them to other values.
        """
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
        """Start the writer thread, which also writes lines logged before this call; return this log."""
        self._writer.start()
        return self

    def writes(self, level: str) -> bool:
        """Return whether lines of *level* are written, or left out by the level of this log."""
        return _LEVELS[level] >= self._lowest

    def debug(self, event: str, **fields: Any) -> None:
        """Log an event that only developers need, such as each answered command."""
        self._line("debug", event, fields)

    def info(self, event: str, **fields: Any) -> None:
        """Log an event of normal operation."""
        self._line("info", event, fields)

    def warning(self, event: str, **fields: Any) -> None:
        """Log an event that an operator should look at."""
        self._line("warning", event, fields)

    def error(self, event: str, **fields: Any) -> None:
        """Log a defect of the platform or of a service."""
        self._line("error", event, fields)

    def close(self, timeout_s: float = 1.0) -> None:
        """Write the remaining lines and stop the writer thread; wait for it at most *timeout_s* seconds."""
        self._over = True
        self._wake.set()
        self._writer.join(timeout_s)

    def _line(self, level: str, event: str, fields: dict[str, Any]) -> None:
        """Queue the line of an event, with long strings cut; drop it if the queue is full."""
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
        """Write the queued lines, in the writer thread, until the log is closed and no line is left."""
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
    """Return *lines* joined into chunks of at most `_CHUNK_BYTES`; a longer line is a chunk of its own."""
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
