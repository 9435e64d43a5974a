"""The folder that a run writes its results to, and the description of machine, versions and settings in it.

Only what an earlier run left is removed from a folder; other files are never touched.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.experiments.results.records import COMMANDS, EVENTS, SAMPLES

__all__ = [
    "environment",
    "finish_report",
    "fresh_folder",
    "load_average",
    "remove_keys",
    "write_json",
]

_WRITTEN = ("report.json", "report.md", COMMANDS, EVENTS, SAMPLES)
_PACKAGES = (
    "rse-pf",
    "numpy",
    "msgspec",
    "websockets",
    "poselib",
    "opencv-python-headless",
    "picows",
    "uvloop",
)


def fresh_folder(folder: Path, files: Sequence[str] = (), folders: Sequence[str] = ()) -> Path:
    """Create *folder*, or remove the results of an earlier run from it; return its absolute path.

    Args:
        folder: Any folder that is empty or holds the events of a run, itself or in its subfolders.
        files: Names of files that this kind of run writes besides its records and reports.
        folders: Patterns of folders that it writes; runs in subfolders are always removed.

    Raises:
        UsageError: It is a file, holds only other files, or cannot be written.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", hint="name a folder with --out")
    try:
        if folder.is_dir() and any(folder.iterdir()):
            runs = [part.parent for part in folder.glob(f"*/{EVENTS}")]
            if not runs and not (folder / EVENTS).exists():
                raise UsageError(f"{folder} holds other files", hint="name an empty folder with --out")
            parts = [part for pattern in folders for part in folder.glob(pattern)]
            for old in [folder / "platform", *runs, *parts]:
                shutil.rmtree(old, ignore_errors=True)
            for name in (*_WRITTEN, *files):
                (folder / name).unlink(missing_ok=True)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"cannot write {folder}: {error.strerror}", hint="name another --out") from error
    return folder.resolve()


def finish_report(
    folder: Path,
    report: Mapping[str, Any],
    page: Callable[[Mapping[str, Any]], str],
    settings: PlatformSettings,
    load_before: list[float],
) -> str:
    """Write ``report.json`` with the machine, versions and load, and ``report.md``; return its text."""
    about = environment(settings)
    about["load_average"] = load_before
    about["load_average_after"] = load_average()
    whole = {**report, "environment": about}
    write_json(folder / "report.json", whole)
    text = page(whole)
    (folder / "report.md").write_text(text, encoding="utf-8")
    return text


def environment(settings: PlatformSettings) -> dict[str, Any]:
    """Return what a reader needs to compare two runs: machine, versions, load and settings."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
        "cores": os.cpu_count(),
        "load_average": load_average(),
        "settings_digest": settings.digest(),
        "versions": versions,
    }


def load_average() -> list[float]:
    """Return the load averages of the last 1, 5 and 15 minutes."""
    return [round(value, 2) for value in os.getloadavg()]


def write_json(path: Path, report: Mapping[str, Any]) -> None:
    """Write *report* as indented JSON."""
    path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


def remove_keys(platform_folder: Path) -> None:
    """Delete the signing keys of a platform that has ended: results never hold a secret."""
    for file in platform_folder.glob("key*.json"):
        file.unlink()
