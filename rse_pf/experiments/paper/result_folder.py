"""The folder of an experiment's results, and what its report says besides its figures.

Promises to remove only what an earlier experiment left, and that every report names the machine, the
versions, the load around the run and the policy it ran under.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.experiments.results.records import COMMANDS, EVENTS, SAMPLES, Records
from rse_pf.experiments.results.report import environment, write_json

__all__ = ["finish_report", "fresh_folder", "generator_of", "policy_of"]

_OWN_FILES = ("report.json", "report.md", COMMANDS, EVENTS, SAMPLES)


def fresh_folder(folder: Path, pictures: tuple[str, ...]) -> Path:
    """Make *folder*; what an earlier experiment left in it is replaced, anything else is not touched.

    Raises:
        UsageError: It is a file, holds something else, or cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", hint="name a folder with --out")
    try:
        if folder.is_dir() and any(folder.iterdir()):
            runs = [part.parent for part in folder.glob(f"*/{EVENTS}")]
            if not runs and not (folder / EVENTS).exists():
                raise UsageError(f"{folder} holds other files", hint="name an empty folder with --out")
            for old in [folder / "platform", *runs]:
                shutil.rmtree(old, ignore_errors=True)
            for name in (*_OWN_FILES, *pictures):
                (folder / name).unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write {folder}: {error.strerror}", hint="name another --out") from error
    return folder.resolve()


def finish_report(
    folder: Path, report: Mapping[str, Any], settings: PlatformSettings, load_before: list[float]
) -> dict[str, Any]:
    """Write ``report.json`` with the machine, versions and load around it; return it."""
    around = environment(settings)
    around["load_average"] = load_before
    around["load_average_after"] = [round(value, 2) for value in os.getloadavg()]
    whole = {**report, "environment": around}
    write_json(folder / "report.json", whole)
    return whole


def generator_of(records: Records) -> dict[str, Any]:
    """Return what a run's records say of the generator; raises UsageError if they say nothing."""
    for event in records.events:
        if event["action"] == "generator":
            return {name: value for name, value in event.items() if name not in ("time", "action")}
    raise UsageError("the events do not speak of the generator", hint="the run did not end")


def policy_of(settings: PlatformSettings, compress: float) -> dict[str, Any]:
    """Return the numbers of the policy that the law needs, periods as they are after compression."""
    scaling = settings.scaling
    return {
        "min_servers": scaling.min_servers,
        "max_servers_allowed": scaling.max_servers,
        "busy_cpu_percent": scaling.busy_cpu_percent,
        "busy_periods": scaling.busy_periods,
        "period_s": scaling.period_s / compress,
        "idle_s": scaling.idle_s / compress,
        "size": settings.serving.emulated_cores,
    }
