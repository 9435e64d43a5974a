"""The action logs: the logs of all processes of a platform in one, by time; also of one that has ended.

Servers write JSON, one object a line; other processes write text.  A log that was rotated or belongs to a
server that started later is followed, too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.errors import UsageError

__all__ = ["LEVELS", "LogFollower", "LogLine", "format_line", "last_lines", "log_files"]

LEVELS = ("debug", "info", "warning", "error")
_TAIL_BYTES = 1 << 20
_HEAD = ("time", "level", "event", "server", "traceback")


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine:
    """One line of the log of ``source``.  ``time_s`` is Unix time."""

    time_s: float
    source: str
    level: str
    text: str


def log_files(folder: Path, server: str | None) -> list[Path]:
    """Return the logs of *folder*, or that of *server*; raises UsageError if there is none."""
    files = sorted(folder.glob("*.log"))
    chosen = [file for file in files if server is None or file.stem == server]
    if chosen:
        return chosen
    names = ", ".join(file.stem for file in files)
    if not names:
        raise UsageError(
            f"no logs in {folder}", hint="start a platform with rse-pf local, or name one with --name"
        )
    raise UsageError(f"there is no log of {str(server)[:80]!r}", hint=f"there are logs of {names}")


def last_lines(files: Sequence[Path], level: str, count: int) -> list[LogLine]:
    """Return the newest *count* lines of at least *level* of all files, oldest first."""
    lines = [line for file in files for line in _parse(file, _tail(file), level)]
    return sorted(lines, key=lambda line: line.time_s)[-count:]


def format_line(line: LogLine) -> str:
    """Return *line* for a person, in the local time of this machine."""
    clock = time.strftime("%H:%M:%S", time.localtime(line.time_s))
    return f"{clock}  {line.source}  {line.level:7}  {line.text}"


class LogFollower:
    """Reads what is appended to the logs of a folder from now on."""

    def __init__(self, folder: Path, server: str | None, level: str) -> None:
        """Begin at the present end of every log."""
        self._folder = folder
        self._server = server
        self._level = level
        self._read = {file: _size(file) for file in self._files()}
        self._rest: dict[Path, bytes] = {}

    def new_lines(self) -> list[LogLine]:
        """Return the lines that were completed since the last call, oldest first."""
        lines = [line for file in self._files() for line in self._of(file)]
        return sorted(lines, key=lambda line: line.time_s)

    def follow(self, take: Callable[[LogLine], None], wait: Callable[[], bool]) -> None:
        """Give every new line to *take*; look again after each *wait* that returns False."""
        while not wait():
            for line in self.new_lines():
                take(line)

    def _files(self) -> list[Path]:
        return [
            file
            for file in sorted(self._folder.glob("*.log"))
            if self._server is None or file.stem == self._server
        ]

    def _of(self, file: Path) -> list[LogLine]:
        at, size = self._read.get(file, 0), _size(file)
        if size < at:  # rotated, or a new process of the same name
            at, self._rest[file] = 0, b""
        if size == at:
            return []
        try:
            with file.open("rb") as opened:
                opened.seek(at)
                data = opened.read(_TAIL_BYTES)
        except OSError:
            return []
        self._read[file] = at + len(data)
        whole, _, self._rest[file] = (self._rest.get(file, b"") + data).rpartition(b"\n")
        return list(_parse(file, whole, self._level))


def _parse(file: Path, data: bytes, level: str) -> Iterator[LogLine]:
    """Yield the lines of *data* of at least *level*; a line of text has the level of the line before it.

    Text before the first line with a time has the time at which the file was written last.
    """
    least = LEVELS.index(level)
    time_s, last = _written_s(file), "info"
    for text in data.decode("utf-8", "replace").splitlines():
        if not text.strip():
            continue
        document = _document(text)
        if document is not None:
            time_s, last = float(document["time"]), str(document["level"])
        if last not in LEVELS or LEVELS.index(last) >= least:
            body = text if document is None else _body(document)
            yield LogLine(time_s=time_s, source=file.stem, level=last, text=body)


def _document(text: str) -> dict[str, Any] | None:
    if not text.startswith("{"):
        return None
    try:
        document = json.loads(text)
        float(document["time"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return {"level": "info", **document} if "event" in document else None


def _body(document: dict[str, Any]) -> str:
    fields = " ".join(f"{name}={_word(value)}" for name, value in document.items() if name not in _HEAD)
    trace = str(document.get("traceback", "")).strip().rpartition("\n")[2]
    return " ".join(word for word in (str(document["event"]), fields, trace) if word)


def _word(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return json.dumps(text) if not text or " " in text else text


def _tail(file: Path) -> bytes:
    try:
        with file.open("rb") as opened:
            start = max(0, _size(file) - _TAIL_BYTES)
            opened.seek(start)
            data = opened.read(_TAIL_BYTES)
    except OSError:
        return b""
    return data.partition(b"\n")[2] if start else data


def _written_s(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:
        return 0.0


def _size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0
