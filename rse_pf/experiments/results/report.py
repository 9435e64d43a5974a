"""What every run that judges writes: raw records first, and a report computed from them alone.

``commands.csv`` has one line a command, ``events.jsonl`` one line an event, ``samples.csv`` one
line a reading of the monitor; `summarise` needs nothing else, so anybody can do it again.
"""

from __future__ import annotations

import csv
import gzip
import json
import os
import platform
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError

__all__ = [
    "PAPER",
    "ROUND_TRIP_PARTS",
    "CommandRecord",
    "EventLog",
    "environment",
    "percentiles",
    "read_commands",
    "summarise",
    "write_commands",
    "write_json",
]

PAPER = {"round_trip_ms": 156.36, "compute_ms": 29.82, "payload_bytes": 10_000, "fps_per_robot": 5.0}
"""The paper's Sect. 6.1 and 6.2: means over a hundred robots, Shenzhen to Seoul."""
ROUND_TRIP_PARTS = ("up_ms", "queue_ms", "compute_ms", "down_ms")
"""Parts of a round trip; the rest is spent in the robot itself (and in a late load generator)."""

_VERSIONS = (
    "rse-pf",
    "numpy",
    "msgspec",
    "websockets",
    "poselib",
    "opencv-python-headless",
    "picows",
    "uvloop",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandRecord:
    """One command, by the robot's own clock (seconds since the run began).

    ``code`` is ``ok`` for a result, a failure's code, or empty when no final answer came.
    ``source`` is ``cloud`` or ``robot``.
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


class EventLog:
    """Events as JSON lines, written as they happen, so that a killed run still tells its story."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, time_s: float, action: str, **details: Any) -> None:
        """Append one event, *time_s* seconds after the run began."""
        self._file.write(json.dumps({"time": round(time_s, 4), "action": action, **details}) + "\n")
        self._file.flush()


def write_commands(path: Path, commands: Iterable[CommandRecord]) -> None:
    """Write ``commands.csv``."""
    names = [field.name for field in fields(CommandRecord)]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        for command in commands:
            values = asdict(command)
            writer.writerow(["" if values[name] is None else values[name] for name in names])


def read_commands(path: Path) -> list[CommandRecord]:
    """Return what `write_commands` wrote, or its ``.gz`` beside it; raises UsageError."""
    packed = path.with_name(f"{path.name}.gz")
    try:
        with (
            gzip.open(packed, "rt", newline="", encoding="utf-8")
            if packed.exists() and not path.exists()
            else path.open(newline="", encoding="utf-8")
        ) as file:
            return [_record(row) for row in csv.DictReader(file)]
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"cannot read {path}: {error}", hint="name the folder of a run") from error


def summarise(commands: Sequence[CommandRecord]) -> dict[str, Any]:
    """Return counts and percentiles of a run.

    *Answered* means a result from the cloud or the robot; *lost* means no final answer at all;
    *twice* counts commands with more than one.
    """
    finals = Counter((command.robot, command.id) for command in commands if command.code)
    failures = Counter(command.code for command in commands if command.code not in ("", "ok"))
    answered = [command for command in commands if command.code == "ok"]
    return {
        "commands": {
            "sent": len({(command.robot, command.id) for command in commands}),
            "answered": len({(command.robot, command.id) for command in answered}),
            "failed": sum(failures.values()),
            "lost": len({(c.robot, c.id) for c in commands if (c.robot, c.id) not in finals}),
            "twice": sum(count > 1 for count in finals.values()),
            "answered_by_robot": sum(command.source == "robot" for command in answered),
        },
        "failures_by_code": dict(failures),
        "payload_bytes": _median_max([c.payload_bytes for c in commands if c.payload_bytes]),
        **{
            name: percentiles([value for c in answered if (value := getattr(c, name)) is not None])
            for name in ("round_trip_ms", "up_ms", "queue_ms", "compute_ms", "down_ms")
        },
        "commands_by_server": dict(Counter(command.server for command in answered)),
    }


def percentiles(values: Sequence[float]) -> dict[str, float | int | None]:
    """Return n, mean, p50, p95, p99 and the maximum, rounded to a microsecond if in ms."""
    if not values:
        return {"n": 0, "mean": None, "p50": None, "p95": None, "p99": None, "max": None}
    p50, p95, p99, largest = np.percentile(values, [50, 95, 99, 100])
    mean = float(np.mean(values))
    named = {"mean": mean, "p50": p50, "p95": p95, "p99": p99, "max": largest}
    return {"n": len(values), **{name: round(float(value), 3) for name, value in named.items()}}


def environment(settings: PlatformSettings) -> dict[str, Any]:
    """Return what a reader needs to compare two runs: machine, versions, load, settings."""
    versions = {}
    for name in _VERSIONS:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
        "cores": os.cpu_count(),
        "load_average": [round(value, 2) for value in os.getloadavg()],
        "settings_digest": settings.digest(),
        "versions": versions,
    }


def write_json(path: Path, report: Mapping[str, Any]) -> None:
    """Write *report* readably."""
    path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def _median_max(values: Sequence[int]) -> dict[str, int | None]:
    if not values:
        return {"median": None, "max": None}
    return {"median": int(np.median(values)), "max": max(values)}


def _record(row: Mapping[str, str]) -> CommandRecord:
    def number(name: str) -> float | None:
        return float(row[name]) if row[name] else None

    return CommandRecord(
        id=int(row["id"]),
        robot=row["robot"],
        planned=float(row["planned"]),
        sent=float(row["sent"]),
        answered=number("answered"),
        server=row["server"],
        code=row["code"],
        source=row["source"],
        payload_bytes=int(row["payload_bytes"]),
        round_trip_ms=number("round_trip_ms"),
        up_ms=number("up_ms"),
        queue_ms=number("queue_ms"),
        compute_ms=number("compute_ms"),
        down_ms=number("down_ms"),
    )
