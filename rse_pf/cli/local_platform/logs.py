"""Read the logs of all processes of a platform as one, by time, for rse-pf local logs and local events.

This also works after the platform has stopped.  Servers write JSON, one object a line; other processes write
text.  The events of the control plane are read from its audit log.  With --follow, logs of servers that start
later are read, too, and a log that was rotated is read from its new beginning.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from rse_pf.audit.entry import parse_entry
from rse_pf.audit.log import CONTROL_PLANE, audit_folder
from rse_pf.audit.log import log_files as log_files_of
from rse_pf.errors import UsageError
from rse_pf.local.events import EVENTS, PLATFORM, event_sentence, level_of

__all__ = [
    "ALL_LINES",
    "LEVELS",
    "LogFilter",
    "LogFollower",
    "LogLine",
    "event_document",
    "format_event",
    "format_line",
    "last_lines",
    "line_document",
    "local_time",
    "log_files",
    "since_time_s",
]

# Levels of a line, lowest first.
LEVELS = ("debug", "info", "warning", "error")
# Bytes that are read at the end of each log if --since is not given, and at most in one reading with
# --follow.
_TAIL_BYTES = 1 << 20
# Fields of a JSON line that are shown by themselves, and not as NAME=VALUE.
_HEAD = ("time", "level", "event", "traceback")
# Beginnings of the names of events that backend servers report in their logs; all others are the control
# plane's.
_OF_SERVERS = ("robot-", "live-")
# An age such as 90s, 5m, 2h or 1.5d.
_AGE = re.compile(r"(?P<count>\d{1,9}(\.\d{1,9})?)(?P<unit>[smhd])")
# Length in seconds of each unit of an age.
_UNIT_S = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine:
    """One line of the log of process ``source``.

    ``time_s`` is Unix time; ``text`` is the line for a person; ``fields`` has the fields of a JSON line, and
    is empty for a line of text.
    """

    time_s: float
    source: str
    level: str
    text: str
    fields: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class LogFilter:
    """The lines that are wanted.

    ``level`` is the lowest level, ``since_s`` the earliest Unix time.  ``robot`` and ``tenant`` are those
    that a line is about; ``process`` is the process that wrote the line, or that it is about.  An empty name
    means any.  Events of the control plane that name no tenant are wanted for every tenant.
    """

    level: str = "debug"
    since_s: float = -math.inf
    robot: str = ""
    tenant: str = ""
    process: str = ""
    events_only: bool = False

    def accepts(self, line: LogLine) -> bool:
        """Return whether *line* is wanted."""
        return (
            (line.level not in LEVELS or LEVELS.index(line.level) >= LEVELS.index(self.level))
            and line.time_s >= self.since_s
            and self.robot in ("", line.fields.get("robot"))
            and (self.tenant in ("", line.fields.get("tenant")) or _concerns_all(line))
            and self.process in ("", line.source, line.fields.get("server"), line.fields.get("name"))
            and (not self.events_only or _is_event(line))
        )


# The filter that accepts every line.
ALL_LINES = LogFilter()


def since_time_s(text: str, now_s: float) -> float:
    """Return the Unix time that *text* means: an age before *now_s* such as 5m, or a date and time.

    A date without a time zone is in the time zone of this machine.

    Raises:
        UsageError: *text* is neither an age nor a date.
    """
    age = _AGE.fullmatch(text)
    if age is not None:
        return now_s - float(age["count"]) * _UNIT_S[age["unit"]]
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        raise UsageError(
            f"--since {text[:40]!r} is neither an age nor a time",
            hint='write an age such as 90s, 5m, 2h or 1d, or a time such as "2026-03-01 14:30:00"',
        ) from None


def log_files(folder: Path, server: str | None) -> list[Path]:
    """Return all log files in *folder*, also those that were rotated.

    Raises:
        UsageError: There is no log, or the process *server*, if it is not None, has none.
    """
    files = [*sorted(folder.glob("*.log.1")), *log_files_of(audit_folder(folder), CONTROL_PLANE)]
    files += [file for file in _all_files(folder) if file not in files]
    if files and (server is None or any(_source(file) == server for file in files)):
        return files
    names = ", ".join(sorted({_source(file) for file in files}))
    if not names:
        raise UsageError(
            f"no logs in {folder}", hint="start a platform with rse-pf local, or name one with --name"
        )
    raise UsageError(f"there is no log of {str(server)[:80]!r}", hint=f"there are logs of {names}")


def last_lines(files: Sequence[Path], wanted: LogFilter, count: int) -> list[LogLine]:
    """Return the *wanted* lines of all *files*, oldest first.

    These are the newest *count* lines, or, if *wanted* has an earliest time, all lines since then.
    """
    is_open = math.isinf(wanted.since_s)
    tail_bytes = _TAIL_BYTES if is_open else None
    lines = [line for file in files for line in _parse(file, _tail(file, tail_bytes), wanted)]
    lines.sort(key=lambda line: line.time_s)
    return lines[-count:] if is_open else lines


def local_time(time_s: float) -> str:
    """Return *time_s* (Unix time) as date and time in the time zone of this machine."""
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(time_s))


def format_line(line: LogLine) -> str:
    """Return *line* as it is printed: local time, process, level and text."""
    return f"{local_time(line.time_s)}  {line.source}  {line.level:7}  {line.text}"


def line_document(line: LogLine) -> dict[str, Any]:
    """Return *line* as plain JSON values: its fields or its text, with time, source and level."""
    fields = line.fields or {"text": line.text}
    return {**fields, "time": line.time_s, "source": line.source, "level": line.level}


def format_event(line: LogLine) -> str:
    """Return the event in *line* as it is printed: local time and a sentence."""
    return f"{local_time(line.time_s)}  {event_sentence(line.fields)}"


def event_document(line: LogLine) -> dict[str, Any]:
    """Return the event in *line* as plain JSON values; tenant and robot are null where it has none."""
    details = {name: value for name, value in line.fields.items() if name not in _HEAD}
    return {"time": line.time_s, "kind": line.fields["event"], "tenant": None, "robot": None, **details}


class LogFollower:
    """Reads the lines that are appended to the logs of a folder after this object was made."""

    def __init__(self, folder: Path, wanted: LogFilter = ALL_LINES) -> None:
        """Note the present end of every log in *folder*; only lines of *wanted* will be returned."""
        self._folder = folder
        self._wanted = wanted
        self._read = {file: _size(file) for file in self._files()}
        self._rest: dict[Path, bytes] = {}

    def new_lines(self) -> list[LogLine]:
        """Return the wanted lines that were completed since the last call, oldest first."""
        lines = [line for file in self._files() for line in self._of(file)]
        return sorted(lines, key=lambda line: line.time_s)

    def follow(self, take: Callable[[LogLine], None], wait: Callable[[], bool]) -> None:
        """Call *take* with every new line, after each call of *wait*, until *wait* returns True."""
        while not wait():
            for line in self.new_lines():
                take(line)

    def _files(self) -> list[Path]:
        return _all_files(self._folder)

    def _of(self, file: Path) -> list[LogLine]:
        """Return the wanted lines that *file* got since the last call.

        An incomplete last line is not returned before the call that reads its end.
        """
        at, size = self._read.get(file, 0), _size(file)
        if size < at:  # the log was rotated, or begun again by a new process of the same name
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
        return list(_parse(file, whole, self._wanted))


def _concerns_all(line: LogLine) -> bool:
    """Return whether *line* is an entry of the control plane that names no tenant."""
    return line.source == CONTROL_PLANE and "tenant" not in line.fields


def _is_event(line: LogLine) -> bool:
    """Return whether *line* is an event that is shown.

    Events of robots and live maps are taken from any log, all others from the control plane's only, since
    other processes log some of them, too.
    """
    kind = line.fields.get("event", "")
    return kind in EVENTS and (line.source == CONTROL_PLANE or kind.startswith(_OF_SERVERS))


def _all_files(folder: Path) -> list[Path]:
    """Return the present log files of all processes, and that of the control plane's audit log."""
    return [*sorted(folder.glob("*.log")), *audit_folder(folder).glob(f"{CONTROL_PLANE}.jsonl")]


def _source(file: Path) -> str:
    """Return the name of the process that wrote the log *file*."""
    return file.name.partition(".")[0]


def _parse(file: Path, data: bytes, wanted: LogFilter) -> Iterator[LogLine]:
    """Yield the *wanted* lines of *data*, a part of the log *file*.

    A line of text gets time and level of the JSON line before it; before the first JSON line, the time at
    which the file was last written, and the level info.
    """
    time_s, last, source = _written_s(file), "info", _source(file)
    for text in data.decode("utf-8", "replace").splitlines():
        if not text.strip():
            continue
        document = _entry_document(text) if source == CONTROL_PLANE else _document(text)
        if document is not None:
            time_s, last = float(document["time"]), str(document["level"])
        body = text if document is None else _body(document, source)
        line = LogLine(time_s=time_s, source=source, level=last, text=body, fields=document or {})
        if wanted.accepts(line):
            yield line


def _entry_document(text: str) -> dict[str, Any] | None:
    """Return the entry in *text*, a line of the control plane's audit log, with the fields of a log line.

    None if *text* is no entry.
    """
    entry = parse_entry(text.encode())
    if entry is None:
        return None
    event = entry.action.removeprefix(PLATFORM)
    subject = {"server": entry.subject} if entry.subject else {}
    return {"time": entry.time, "level": level_of(event), "event": event, **subject, **entry.detail}


def _document(text: str) -> dict[str, Any] | None:
    """Return the fields of the JSON line *text*; None if it is no JSON object with time and event."""
    if not text.startswith("{"):
        return None
    try:
        document = json.loads(text)
        float(document["time"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return {"level": "info", **document} if "event" in document else None


def _body(document: Mapping[str, Any], source: str) -> str:
    """Return the text of a JSON line: event, fields as NAME=VALUE, and the last line of a traceback."""
    fields = " ".join(
        f"{name}={_word(value)}"
        for name, value in document.items()
        if name not in _HEAD and (name != "server" or source == CONTROL_PLANE)
    )
    trace = str(document.get("traceback", "")).strip().rpartition("\n")[2]
    return " ".join(word for word in (str(document["event"]), fields, trace) if word)


def _word(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return json.dumps(text) if not text or " " in text else text


def _tail(file: Path, most: int | None) -> bytes:
    """Return the whole lines in the last *most* bytes of *file* (None: all); b"" if it is missing."""
    try:
        with file.open("rb") as opened:
            start = 0 if most is None else max(0, _size(file) - most)
            opened.seek(start)
            data = opened.read(most)
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
