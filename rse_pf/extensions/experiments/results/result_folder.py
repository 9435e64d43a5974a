"""The folder of results of a run, and the description of machine, versions and settings in its report.

A folder that holds other files than those of an earlier run is an error, and nothing is removed from it.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from importlib import metadata
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.results.records import COMMANDS, EVENTS, SAMPLES

__all__ = [
    "RUN_FILES",
    "commit_of",
    "environment",
    "finish_report",
    "fresh_folder",
    "load_average",
    "write_json",
]

RUN_FILES = ("report.json", "report.md", COMMANDS, EVENTS, SAMPLES, "platform")
"""Names of the files and the folder that every experiment and the demo write."""
_CHECKOUT = Path(__file__).resolve().parents[4]
# Time limit of ``git describe``, in seconds.
_GIT_TIMEOUT_S = 10.0
# Packages whose versions the report states.
_PACKAGES = (
    "rse-pf",
    "numpy",
    "msgspec",
    "websockets",
    "opencv-python-headless",
    "picows",
    "uvloop",
)


def fresh_folder(folder: Path, written: Sequence[str]) -> Path:
    """Create *folder*, or remove the results of an earlier run from it; return its absolute path.

    Args:
        folder: Any folder that is empty or holds the results of an earlier run of the same kind.
        written: Names of all files and folders that this kind of run writes; they may be patterns.

    Raises:
        UsageError: *folder* is a file, holds other files, holds no events of a run, or cannot be written.
            Other files are never removed.
    """
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file", hint="name a folder with --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        old = list(folder.iterdir())
        own = [path for path in old if any(fnmatchcase(path.name, name) for name in written)]
        is_run = (folder / EVENTS).exists() or any(folder.glob(f"*/{EVENTS}"))
        if own != old or (old and not is_run):
            raise UsageError(f"{folder} holds other files", hint="name an empty folder with --out")
        for entry in old:
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            else:
                entry.unlink()
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
    """Write ``report.json`` and ``report.md`` to *folder*, and return the text of ``report.md``.

    The environment of the run is added to *report*: machine, versions, settings and load average.  *page*
    formats the complete report as Markdown; *load_before* is the load average before the run.
    """
    about = environment(settings)
    about["load_average"] = load_before
    about["load_average_after"] = load_average()
    whole = {**report, "environment": about}
    write_json(folder / "report.json", whole)
    text = page(whole)
    (folder / "report.md").write_text(text, encoding="utf-8")
    return text


def environment(settings: PlatformSettings) -> dict[str, Any]:
    """Return commit, Python, system, cores, load average, digest of *settings* and versions, for a report."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "commit": commit_of(_CHECKOUT),
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()}",
        "cores": os.cpu_count(),
        "load_average": load_average(),
        "settings_digest": settings.digest(),
        "versions": versions,
    }


def commit_of(checkout: Path) -> str:
    """Return the commit hash of *checkout*, with ``+changes`` if tracked files are modified.

    The text is empty if *checkout* is no Git working tree, or Git fails.
    """
    if not (checkout / ".git").exists():
        return ""
    command = ["git", "-C", str(checkout), "describe", "--always", "--exclude=*", "--abbrev=40"]
    try:
        asked = subprocess.run(
            [*command, "--dirty=+changes"],
            capture_output=True,
            text=True,
            timeout=_GIT_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return asked.stdout.strip() if asked.returncode == 0 else ""


def load_average() -> list[float]:
    """Return the load averages of the last 1, 5 and 15 minutes."""
    return [round(value, 2) for value in os.getloadavg()]


def write_json(path: Path, report: Mapping[str, Any]) -> None:
    """Write *report* as indented JSON."""
    path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
