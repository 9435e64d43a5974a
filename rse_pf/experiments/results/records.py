"""Raw records of an experiment: events and the monitor's readings, written as they come, read back to judge.

``samples.csv`` has a row for each server of each reading, ``events.jsonl`` a line for each event; the first
event, ``experiment``, says what was asked.  Promises that what is read back equals what was written, and
that nothing here is computed: sums and percentiles belong to whoever judges.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any, TextIO

from rse_pf.errors import UsageError
from rse_pf.experiments.results.report import CommandRecord, read_commands, summarise

__all__ = [
    "COMMANDS",
    "EVENTS",
    "SAMPLES",
    "RecordedSample",
    "Records",
    "SampleLog",
    "ServerSample",
    "asked_of",
    "read_records",
    "read_samples",
    "reading_of",
    "summary_of",
]

COMMANDS, EVENTS, SAMPLES = "commands.csv", "events.jsonl", "samples.csv"
_WRONG = (OSError, ValueError, KeyError, TypeError, AttributeError)

Event = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerSample:
    """One server in one reading.  ``cpu_percent`` is relative to its size; None when it did not answer."""

    server: str
    pid: int
    state: str
    robots: int = 0
    cpu_percent: float | None = None
    requests: int = 0
    queue: int = 0
    queue_ms: float = 0.0
    in_flight: int = 0
    bytes_in: int = 0
    bytes_out: int = 0
    warming: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedSample:
    """All servers at one time, seconds since the run began."""

    time: float
    healthy_servers: int
    servers: tuple[ServerSample, ...] = ()

    @property
    def cpu_percent(self) -> float | None:
        """Return the mean over servers past their warm-up that answered; None if there is none."""
        known = [
            each.cpu_percent for each in self.servers if each.cpu_percent is not None and not each.warming
        ]
        return sum(known) / len(known) if known else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Records:
    """Everything a run left behind, in time's order."""

    commands: Sequence[CommandRecord]
    events: Sequence[Event]
    readings: Sequence[RecordedSample]
    folder: Path = Path()


_NAMES = [field.name for field in fields(ServerSample)]


class SampleLog:
    """The monitor's readings as CSV lines, written as they come."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._writer = csv.writer(file)
        self._writer.writerow(["time", "healthy_servers", *_NAMES])

    def write(self, reading: RecordedSample) -> None:
        """Append one reading; one without servers is one row without a name."""
        head = [reading.time, reading.healthy_servers]
        for each in reading.servers:
            values = [getattr(each, name) for name in _NAMES]
            self._writer.writerow([*head, *(_spelt(value) for value in values)])
        if not reading.servers:
            self._writer.writerow([*head, *("" for _ in _NAMES)])
        self._file.flush()


def reading_of(told: Mapping[str, Any], origin_s: float) -> RecordedSample:
    """Return a monitor's reading, whose time is monotonic, as seconds since *origin_s*."""
    servers = tuple(
        ServerSample(
            server=str(each["name"]),
            **{name: each[name] for name in _NAMES if name != "server" and each.get(name) is not None},
        )
        for each in told["servers"]
    )
    healthy = int(told["healthy_servers"])
    return RecordedSample(time=round(told["time"] - origin_s, 4), healthy_servers=healthy, servers=servers)


def read_records(folder: Path) -> Records:
    """Return the records of the run in *folder*.

    Raises:
        UsageError: A file is missing, or is not what `SampleLog` and `EventLog` write.
    """
    return Records(
        commands=read_commands(folder / COMMANDS),
        events=_read_events(folder / EVENTS),
        readings=read_samples(folder / SAMPLES),
        folder=folder,
    )


def asked_of(records: Records) -> dict[str, Any]:
    """Return what the run's first event says was asked of it; raises UsageError if there is none."""
    for event in records.events:
        if event["action"] == "experiment":
            return {name: value for name, value in event.items() if name not in ("time", "action")}
    raise UsageError("the events do not say which experiment this was", hint=f"look into {EVENTS}")


def summary_of(records: Records) -> dict[str, Any]:
    """Return `summarise` of the commands, with what the robots' processes saw besides: second answers.

    A second answer has no row of its own; the generator's event counts what reached a caller twice, and the
    poses that were far from the truth.
    """
    summary = summarise(records.commands)
    told = [event for event in records.events if event["action"] == "generator"]
    twice = sum(int(event.get("twice", 0)) for event in told)
    summary["commands"]["twice"] = max(summary["commands"]["twice"], twice)
    summary["wrong_poses"] = sum(int(event.get("wrong_poses", 0)) for event in told)
    return summary


def _read_events(path: Path) -> list[Event]:
    try:
        events = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
        for event in events:
            float(event["time"])
            str(event["action"])
    except _WRONG as error:
        raise UsageError(f"cannot read {path}: {error}", hint="name the folder of a run") from error
    return sorted(events, key=lambda event: float(event["time"]))


def read_samples(path: Path) -> list[RecordedSample]:
    """Return what `SampleLog` wrote; raises UsageError."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return list(_readings(csv.DictReader(file)))
    except _WRONG as error:
        raise UsageError(f"cannot read {path}: {error}", hint="name the folder of a run") from error


def _readings(rows: Iterator[Mapping[str, str]] | csv.DictReader[str]) -> Iterator[RecordedSample]:
    for (time_s, healthy), group in groupby(rows, key=lambda row: (row["time"], row["healthy_servers"])):
        servers = tuple(_server(row) for row in group if row["server"])
        yield RecordedSample(time=float(time_s), healthy_servers=int(healthy), servers=servers)


def _server(row: Mapping[str, str]) -> ServerSample:
    counts = ("pid", "robots", "requests", "queue", "in_flight", "bytes_in", "bytes_out")
    whole = {name: int(float(row[name])) for name in counts}
    return ServerSample(
        server=row["server"],
        state=row["state"],
        cpu_percent=float(row["cpu_percent"]) if row["cpu_percent"] else None,
        queue_ms=float(row["queue_ms"]),
        warming=row["warming"] == "1",
        **whole,
    )


def _spelt(value: Any) -> Any:
    if value is None:
        return ""
    return int(value) if isinstance(value, bool) else value
