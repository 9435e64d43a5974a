"""Check a report against its raw records, and the records against the invariants of every run.

All figures are computed again from commands, events and samples, and compared with those in ``report.json``,
so that a change of a record or of the report is found.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.paper.elasticity import elasticity_figures, find_unjustified_scale_outs
from rse_pf.extensions.experiments.paper.latency import latency_figures
from rse_pf.extensions.experiments.paper.live_map import live_experiment_figures
from rse_pf.extensions.experiments.paper.mapping import CLOUD, map_figures
from rse_pf.extensions.experiments.paper.robustness import robustness_figures
from rse_pf.extensions.experiments.results.live_faults import live_fault_figures
from rse_pf.extensions.experiments.results.records import EVENTS, Records, parameters_of, read_records
from rse_pf.storage.files import read_document

__all__ = [
    "FigureCheck",
    "broken_invariants",
    "figures_of",
    "read_report",
    "report_folders",
    "run_folders",
    "verify",
]

# Largest difference between a round trip and its time stamps that rounding explains, in ms.
_MAX_ROUNDING_MS = 0.01
# The figure that needs the point clouds, which shipped results may lack.
_CLOUD_FIGURE = "map_points"
# Largest number of characters of a value in the output; longer values are cut.
_MAX_SHOWN_CHARACTERS = 60
# Experiments whose round trips count from the real send time: their robots plan frames, not commands.
_FRAME_EXPERIMENTS = {"map", "live", "live-fault"}
# Hint of errors about a folder that holds no results.
_HINT = "name the --out of an experiment"

# The function that computes the figures of a run, by the kind of its experiment.
FIGURES: dict[str, Callable[[Records], dict[str, Any]]] = {
    "elasticity": elasticity_figures,
    "latency": latency_figures,
    "robustness": robustness_figures,
    "map": map_figures,
    "live": live_experiment_figures,
    "live-fault": live_fault_figures,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class FigureCheck:
    """The check of one figure or invariant; ``agrees`` is None for a figure whose records were not kept."""

    what: str
    agrees: bool | None
    detail: str = ""

    def __str__(self) -> str:
        """Return the check as the line that is printed: outcome, name and detail."""
        outcome = "skipped" if self.agrees is None else "agrees" if self.agrees else "DIFFERS"
        return f"{outcome:<7}  {self.what}  {self.detail}".rstrip()


def figures_of(records: Records) -> dict[str, Any]:
    """Return the figures of a run, computed from *records*.

    Raises UsageError if its experiment is unknown.
    """
    kind = str(parameters_of(records).get("kind"))
    if kind not in FIGURES:
        raise UsageError(
            f"{records.folder}: there is no experiment {kind!r}", hint=f"known are {', '.join(FIGURES)}"
        )
    return FIGURES[kind](records)


def run_folders(folder: Path) -> dict[str, Path]:
    """Return the folder of each run of an experiment, by the run's name in the report.

    The name is ``""`` if *folder* itself holds the records of a single run.

    Raises:
        UsageError: There are no records of a run in *folder*.
    """
    if (folder / EVENTS).exists():
        return {"": folder}
    parts = {part.parent.name: part.parent for part in sorted(folder.glob(f"*/{EVENTS}"))}
    if not parts:
        raise UsageError(f"{folder} holds no run", hint=_HINT)
    return parts


def verify(folder: Path) -> list[FigureCheck]:
    """Check each figure and invariant of each run in *folder*, or of the experiments in its folders.

    Raises:
        UsageError: The folder holds no run, or a record or the report cannot be read.
    """
    parts = report_folders(folder)
    if parts != [folder]:
        return [_prefix(part.name, check) for part in parts for check in verify(part)]
    report = read_report(folder)
    checks: list[FigureCheck] = []
    runs = run_folders(folder)
    for name, part in runs.items():
        reported = report if not name else report.get("runs", {}).get(name)
        if isinstance(reported, dict):
            checks += [_prefix(name, check) for check in _verify_run(part, reported)]
        else:
            checks.append(FigureCheck(what=f"{name}: run", agrees=False, detail="is not in the report"))
    if "" not in runs:
        for name in sorted(set(report.get("runs", {})) - set(runs)):
            checks.append(FigureCheck(what=f"{name}: run", agrees=False, detail="has no records"))
    return checks


def report_folders(folder: Path) -> list[Path]:
    """Return the folders of experiments: *folder* if it has a report, else its subfolders that have one.

    If no subfolder has one either, the result is *folder*.
    """
    below = [report.parent for report in sorted(folder.glob("*/report.json"))]
    return [folder] if (folder / "report.json").exists() or not below else below


def broken_invariants(records: Records) -> dict[str, str]:
    """Return for each invariant, by its sentence, how the run violates it; an empty text if it holds."""
    commands = figures_of(records)["commands"]
    invariants = {
        "every command came to an end": _if(commands["lost"], f"{commands['lost']} lost"),
        "no answer was delivered twice": _if(commands["twice"], f"{commands['twice']} twice"),
        "every command is counted once": _if(
            commands["sent"] != commands["answered"] + commands["failed"] + commands["lost"],
            f"{commands['sent']} sent, {commands['answered']} answered, {commands['failed']} failed, "
            f"{commands['lost']} lost",
        ),
        "no command is answered before it is sent, and a round trip is what its time stamps say": (
            _wrong_round_trip(records)
        ),
    }
    if parameters_of(records)["kind"] == "elasticity":
        wrong = find_unjustified_scale_outs(records)
        invariants["every scale-out follows the required busy samples"] = "; ".join(wrong)
    return invariants


def _verify_run(folder: Path, reported: Mapping[str, Any]) -> Iterator[FigureCheck]:
    records = read_records(folder)
    figures = json.loads(json.dumps(figures_of(records)))
    for path, value in _leaves(figures):
        if path == (_CLOUD_FIGURE,) and None in value:
            yield FigureCheck(what=_CLOUD_FIGURE, agrees=None, detail=f"{CLOUD} is not kept here")
        else:
            yield _compare(reported, path, value)
    for name, broken in broken_invariants(records).items():
        yield FigureCheck(what=f"invariant: {name}", agrees=not broken, detail=broken)


def _prefix(name: str, check: FigureCheck) -> FigureCheck:
    label = f"{name}: {check.what}" if name else check.what
    return FigureCheck(what=label, agrees=check.agrees, detail=check.detail)


def _wrong_round_trip(records: Records) -> str:
    mapping = parameters_of(records)["kind"] in _FRAME_EXPERIMENTS
    for command in records.commands:
        if command.code != "ok" or command.answered is None or command.round_trip_ms is None:
            continue
        trip_ms = 1000.0 * (command.answered - (command.sent if mapping else command.planned))
        over_ms = trip_ms - command.round_trip_ms
        # A mapping robot does other work between the end of the round trip and the time stamp of the answer.
        wrong = over_ms < -_MAX_ROUNDING_MS if mapping else abs(over_ms) > _MAX_ROUNDING_MS
        if command.answered < command.sent or wrong:
            return (
                f"command {command.id} of {command.robot}: planned {command.planned}, sent {command.sent}, "
                f"answered {command.answered}, round trip {command.round_trip_ms} ms"
            )
    return ""


def _compare(reported: Mapping[str, Any], path: tuple[str, ...], value: Any) -> FigureCheck:
    label, missing = "/".join(path), object()
    there: Any = reported
    for step in path:
        there = there.get(step, missing) if isinstance(there, dict) else missing
    if there is missing:
        return FigureCheck(what=label, agrees=False, detail="is not in the report")
    if there == value:
        return FigureCheck(what=label, agrees=True, detail=_short(value))
    return FigureCheck(what=label, agrees=False, detail=f"report {_short(there)}, records {_short(value)}")


def _leaves(
    figures: Mapping[str, Any], before: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name, value in figures.items():
        path = (*before, name)
        if isinstance(value, dict) and value:
            yield from _leaves(value, path)
        else:
            yield path, value


def read_report(folder: Path) -> dict[str, Any]:
    """Return ``report.json`` of *folder*; raises UsageError if it cannot be read or is no JSON object."""
    path = folder / "report.json"
    report = read_document(path, "a report", hint=_HINT)
    if not isinstance(report, dict):
        raise UsageError(f"{path} is not a report", hint=_HINT)
    return report


def _short(value: Any) -> str:
    text = json.dumps(value)
    if isinstance(value, list) and len(text) > _MAX_SHOWN_CHARACTERS:
        return f"{len(value)} entries"
    return text if len(text) <= _MAX_SHOWN_CHARACTERS else text[: _MAX_SHOWN_CHARACTERS - 3] + "..."


def _if(broken: Any, text: str) -> str:
    return text if broken else ""
