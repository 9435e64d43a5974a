"""Recompute a report from its raw records, and hold the laws that no honest run breaks.

Promises never to take a figure from ``report.json``: it reads the commands, events and readings, judges them
again, and only then compares.  An edited record and an edited report both show.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.errors import UsageError
from rse_pf.experiments.paper.elasticity_report import judge_elasticity, unjustified_scale_outs
from rse_pf.experiments.paper.latency_report import judge_latency
from rse_pf.experiments.paper.mapping_report import judge_map
from rse_pf.experiments.paper.robustness_report import judge_scenario
from rse_pf.experiments.results.records import EVENTS, Records, asked_of, read_records

__all__ = ["Discrepancy", "broken_laws", "judge_folder", "run_folders", "verify"]

_CLOCK_MS = 0.01
_SHOWN = 60

JUDGES: dict[str, Callable[[Records], dict[str, Any]]] = {
    "elasticity": judge_elasticity,
    "latency": judge_latency,
    "robustness": judge_scenario,
    "map": judge_map,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Discrepancy:
    """One line of the verdict."""

    what: str
    agrees: bool
    detail: str = ""

    def __str__(self) -> str:
        """Return the line as it is printed."""
        return f"{'agrees ' if self.agrees else 'DIFFERS'}  {self.what}  {self.detail}".rstrip()


def judge_folder(folder: Path) -> dict[str, Any]:
    """Return what the records in *folder* say; raises UsageError for a folder that is no run."""
    records = read_records(folder)
    kind = str(asked_of(records).get("kind"))
    if kind not in JUDGES:
        raise UsageError(f"{folder}: {kind!r} is no experiment", hint=f"known are {', '.join(JUDGES)}")
    return JUDGES[kind](records)


def run_folders(folder: Path) -> dict[str, Path]:
    """Return the runs of an experiment by the name its report has for them; one run is named ``""``.

    Raises:
        UsageError: There is no run.
    """
    if (folder / EVENTS).exists():
        return {"": folder}
    parts = {part.parent.name: part.parent for part in sorted(folder.glob(f"*/{EVENTS}"))}
    if not parts:
        raise UsageError(f"{folder} holds no run", hint="name the --out of an experiment")
    return parts


def verify(folder: Path) -> list[Discrepancy]:
    """Return a finding for each figure of each run in *folder*, and for each law.

    Raises:
        UsageError: The folder holds no run, or a record or the report cannot be read.
    """
    report = _read_report(folder)
    found: list[Discrepancy] = []
    runs = run_folders(folder)
    for name, part in runs.items():
        told = report if not name else report.get("runs", {}).get(name)
        prefix = f"{name}: " if name else ""
        if not isinstance(told, dict):
            found.append(Discrepancy(what=f"{prefix}run", agrees=False, detail="is not in the report"))
            continue
        judged = json.loads(json.dumps(judge_folder(part)))
        found += [_compare(prefix, told, path, value) for path, value in _leaves(judged)]
        found += [
            Discrepancy(what=f"{prefix}law: {law}", agrees=not broken, detail=broken)
            for law, broken in broken_laws(read_records(part)).items()
        ]
    if "" not in runs:
        for name in sorted(set(report.get("runs", {})) - set(runs)):
            found.append(Discrepancy(what=f"{name}: run", agrees=False, detail="has no records"))
    return found


def broken_laws(records: Records) -> dict[str, str]:
    """Return every law and what breaks it; an empty text is a law that holds."""
    judged = JUDGES[str(asked_of(records)["kind"])](records)
    commands = judged["commands"]
    laws = {
        "every command came to an end": _if(commands["lost"], f"{commands['lost']} lost"),
        "no answer was delivered twice": _if(commands["twice"], f"{commands['twice']} twice"),
        "every command is counted once": _if(
            commands["sent"] != commands["answered"] + commands["failed"] + commands["lost"],
            f"{commands['sent']} sent, {commands['answered']} answered, {commands['failed']} failed, "
            f"{commands['lost']} lost",
        ),
        "no command is answered before it is sent, and a round trip is what its time stamps say": _clocks(
            records
        ),
    }
    if asked_of(records)["kind"] == "elasticity":
        wrong = unjustified_scale_outs(records)
        laws["every scale-out follows the required busy samples"] = "; ".join(wrong)
    return laws


def _clocks(records: Records) -> str:
    asks_late = asked_of(records)["kind"] == "map"  # a mapping robot plans frames, not commands
    for command in records.commands:
        if command.code != "ok" or command.answered is None or command.round_trip_ms is None:
            continue
        begun = command.sent if asks_late else command.planned
        trip_ms = 1000.0 * (command.answered - begun)
        wrong = trip_ms < command.round_trip_ms - _CLOCK_MS
        if not asks_late:  # else the robot's own work lies between
            wrong = abs(trip_ms - command.round_trip_ms) > _CLOCK_MS
        if command.answered < command.sent or wrong:
            return (
                f"command {command.id} of {command.robot}: planned {command.planned}, sent {command.sent}, "
                f"answered {command.answered}, round trip {command.round_trip_ms} ms"
            )
    return ""


def _compare(prefix: str, told: Mapping[str, Any], path: tuple[str, ...], value: Any) -> Discrepancy:
    what, missing = prefix + "/".join(path), object()
    here: Any = told
    for step in path:
        here = here.get(step, missing) if isinstance(here, dict) else missing
    if here is missing:
        return Discrepancy(what=what, agrees=False, detail="is not in the report")
    if here == value:
        return Discrepancy(what=what, agrees=True, detail=_short(value))
    return Discrepancy(what=what, agrees=False, detail=f"report {_short(here)}, records {_short(value)}")


def _leaves(judged: Mapping[str, Any], before: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, value in judged.items():
        path = (*before, name)
        if isinstance(value, dict) and value:
            yield from _leaves(value, path)
        else:
            yield path, value


def _read_report(folder: Path) -> dict[str, Any]:
    path = folder / "report.json"
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UsageError(f"cannot read {path}: {error}", hint="name the --out of an experiment") from error
    if not isinstance(report, dict):
        raise UsageError(f"{path} is not a report", hint="name the --out of an experiment")
    return report


def _short(value: Any) -> str:
    text = json.dumps(value)
    if isinstance(value, list) and len(text) > _SHOWN:
        return f"{len(value)} entries"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."


def _if(broken: Any, text: str) -> str:
    return text if broken else ""
