"""The raw records of a run: commands, events and samples of the monitor, and the files that hold them.

``commands.csv`` has one line per command, ``events.jsonl`` one line per event, and ``samples.csv`` one line
per server of each sample.  The first event, ``experiment``, holds the parameters of the run.
"""

from __future__ import annotations

import csv
import gzip
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any, TextIO, TypeVar

import msgspec

from rse_pf.errors import UsageError
from rse_pf.local.control.monitor import MonitorSample, ServerSample, monitor_sample

__all__ = [
    "COMMANDS",
    "EVENTS",
    "SAMPLES",
    "TRUTH",
    "CommandRecord",
    "Event",
    "EventLog",
    "Records",
    "SampleLog",
    "event_details",
    "parameters_of",
    "read_commands",
    "read_records",
    "read_samples",
    "robot_names",
    "run_sample",
    "sample_from_document",
    "write_commands",
]

COMMANDS = "commands.csv"
"""Name of the file with the commands of a run."""
EVENTS = "events.jsonl"
"""Name of the file with the events of a run."""
SAMPLES = "samples.csv"
"""Name of the file with the samples of the monitor during a run."""
TRUTH = "truth.txt"
"""Name of the file with a robot's true trajectory, in the folder of the robot."""
# Exceptions that a missing or malformed file of records raises.
_MALFORMED = (OSError, ValueError, KeyError, TypeError, AttributeError)
# Hint of errors about missing or malformed records.
_HINT = "name the folder of a run"

Event = Mapping[str, Any]
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandRecord:
    """One command of a robot.

    ``planned``, ``sent`` and ``answered`` are seconds since the start of the run by the robot's clock.
    ``code`` is ``ok`` for a result, the code of a failure, or empty if no final answer arrived.  ``source``
    is ``cloud``, or ``robot`` if the robot computed the result itself.
    """

    id: int
    robot: str
    planned: float
    sent: float
    answered: float | None
    server: str
    code: str
    source: str = "cloud"
    payload_bytes: int = 0
    round_trip_ms: float | None = None
    up_ms: float | None = None
    queue_ms: float | None = None
    compute_ms: float | None = None
    down_ms: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Records:
    """All records of a run; events are in the order of time, commands and samples in that of their files."""

    commands: Sequence[CommandRecord]
    events: Sequence[Event]
    samples: Sequence[MonitorSample]
    folder: Path = Path()


# Columns of ``commands.csv``.
_COMMAND_COLUMNS = [field.name for field in fields(CommandRecord)]
# Columns of ``samples.csv`` that describe a server.
_SERVER_COLUMNS = ["server", *(field.name for field in fields(ServerSample) if field.name != "name")]


class EventLog:
    """Writer of events as JSON lines.

    Each is flushed at once, so that the events of a killed run are kept.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, time_s: float, action: str, **details: Any) -> None:
        """Append one event, *time_s* seconds after the start of the run."""
        self._file.write(json.dumps({"time": round(time_s, 4), "action": action, **details}) + "\n")
        self._file.flush()

    def copy(self, event: Event, time_s: float) -> None:
        """Append *event* of a platform or swarm, named by its field ``event``, with the time *time_s*."""
        self.write(time_s, str(event["event"]), **event_details(event))


def event_details(event: Event) -> dict[str, Any]:
    """Return the fields of an event without its name and time."""
    return {name: value for name, value in event.items() if name not in ("event", "time", "action")}


class SampleLog:
    """Writer of the monitor's samples as CSV lines; each sample is flushed at once."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._writer = csv.writer(file)
        self._writer.writerow(["time", "healthy_servers", *_SERVER_COLUMNS])

    def write(self, sample: MonitorSample) -> None:
        """Append a row for each server of *sample*.

        A sample without servers is one row whose server columns are empty.
        """
        head = [sample.time, sample.healthy_servers]
        for name, *values in (asdict(server).values() for server in sample.servers):
            self._writer.writerow([*head, name, *(_csv_value(value) for value in values)])
        if not sample.servers:
            self._writer.writerow([*head, *("" for _ in _SERVER_COLUMNS)])
        self._file.flush()


def run_sample(time_s: float, healthy_servers: int, servers: Sequence[ServerSample] = ()) -> MonitorSample:
    """Return a monitor sample of *servers* at *time_s* (s since the start of the run)."""
    return replace(monitor_sample(time_s, servers, frozenset()), healthy_servers=healthy_servers)


def sample_from_document(document: Mapping[str, Any], origin_s: float) -> MonitorSample:
    """Return the monitor sample in *document*, with its monotonic time counted from *origin_s*."""
    servers = msgspec.convert(document["servers"], tuple[ServerSample, ...])
    return run_sample(round(document["time"] - origin_s, 4), int(document["healthy_servers"]), servers)


def write_commands(path: Path, commands: Iterable[CommandRecord]) -> None:
    """Write *commands* to the CSV file *path*, with a header."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(_COMMAND_COLUMNS)
        for command in commands:
            writer.writerow([_csv_value(value) for value in asdict(command).values()])


def read_records(folder: Path) -> Records:
    """Return the records of the run in *folder*.

    Raises:
        UsageError: A file is missing or malformed.
    """
    return Records(
        commands=read_commands(folder / COMMANDS),
        events=_read_events(folder / EVENTS),
        samples=read_samples(folder / SAMPLES),
        folder=folder,
    )


def parameters_of(records: Records) -> dict[str, Any]:
    """Return the details of the event ``experiment``, the parameters of the run.

    Raises UsageError without it.
    """
    for event in records.events:
        if event["action"] == "experiment":
            return event_details(event)
    raise UsageError(
        "the events do not say which experiment this was", hint=f"check the event experiment in {EVENTS}"
    )


def robot_names(count: int) -> list[str]:
    """Return the names of the robots of a run, which are those of their folders."""
    return [f"robot-{number}" for number in range(1, count + 1)]


def read_commands(path: Path) -> list[CommandRecord]:
    """Return the commands in a file of `write_commands`; raises UsageError if it is missing or malformed."""
    return _read(path, lambda rows: map(_command, rows))


def read_samples(path: Path) -> list[MonitorSample]:
    """Return the samples in a file of `SampleLog`; raises UsageError if it is missing or malformed."""
    return _read(path, _samples)


def _read_events(path: Path) -> list[Event]:
    try:
        events = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
        return sorted(
            ({**event, "action": str(event["action"])} for event in events),
            key=lambda event: float(event["time"]),
        )
    except _MALFORMED as error:
        raise UsageError(f"cannot read {path}: {error}", hint=_HINT) from error


def _read(path: Path, parse: Callable[[Iterable[Mapping[str, str]]], Iterable[T]]) -> list[T]:
    """Return the values that *parse* yields for the rows of a CSV file.

    If there is only a copy compressed by gzip, with the additional ending ``.gz``, that file is read.
    """
    compressed = path.with_name(f"{path.name}.gz")
    try:
        with (
            gzip.open(compressed, "rt", newline="", encoding="utf-8")
            if compressed.exists() and not path.exists()
            else path.open(newline="", encoding="utf-8")
        ) as file:
            return list(parse(csv.DictReader(file)))
    except _MALFORMED as error:
        raise UsageError(f"cannot read {path}: {error}", hint=_HINT) from error


def _samples(rows: Iterable[Mapping[str, str]]) -> Iterator[MonitorSample]:
    for (time_s, healthy), group in groupby(rows, key=lambda row: (row["time"], row["healthy_servers"])):
        yield run_sample(float(time_s), int(healthy), [_server(row) for row in group if row["server"]])


def _server(row: Mapping[str, str]) -> ServerSample:
    known = {name: row[name] or None for name in _SERVER_COLUMNS if name != "server"}
    return msgspec.convert({"name": row["server"], **known}, ServerSample, strict=False)


def _command(row: Mapping[str, str]) -> CommandRecord:
    text = ("server", "code")
    known = {name: row[name] if name in text else row[name] or None for name in _COMMAND_COLUMNS}
    return msgspec.convert(known, CommandRecord, strict=False)


def _csv_value(value: Any) -> Any:
    if value is None:
        return ""
    return int(value) if isinstance(value, bool) else value
