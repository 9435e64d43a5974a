"""Services that the operator installs: a folder each, in Python, C/C++ or Lua, pinned by its hashes.

Robots never send code: a server runs what lies in its services folder, and only as it was installed.
Promises to execute nothing of a service, and to refuse a folder of which one byte was changed since.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.service import Kind

__all__ = [
    "ENTRY_POINTS",
    "LANGUAGES",
    "InstalledService",
    "install",
    "installed_services",
    "published_services",
    "read_service",
]

LANGUAGES = ("python", "cpp", "lua")

ENTRY_POINTS = "rse_pf.services"
"""Entry-point group by which Python packages publish services: ``name = "package.module"``."""

_PACKAGE = "package"
_MANIFEST, _PINS = "service.json", "pins.json"
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")
_KINDS = ("stateless", "per_robot_state")
_FIELDS = {"name", "language", "entry", "kind"}
_LEFT_OUT = {
    "__pycache__", ".git", ".pytest_cache", "requests", "tests", _PINS,
    "CMakeFiles", "CMakeCache.txt", "cmake_install.cmake", "Makefile",
}  # fmt: skip
"""What a server does not need: recorded requests, tests and the clutter of a build stay with their author."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InstalledService:
    """One service folder.

    ``entry`` is the file that is run: a Python or Lua source, or a shared library; for a service that a
    Python package publishes (language ``package``) it is the module's dotted name.  A ``stateless``
    service may be tried again on another environment; a ``per_robot_state`` one lives as long as
    the robot's connection.
    """

    name: str
    language: str
    entry: str
    kind: Kind
    folder: Path

    @property
    def entry_path(self) -> Path:
        """Where the file that is run lies."""
        return self.folder / self.entry


def read_service(folder: Path) -> InstalledService:
    """Return what ``service.json`` in *folder* says.

    Raises:
        UsageError: It is missing, is not JSON, or says something that cannot be.
    """
    path = folder / _MANIFEST
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(
            f"cannot read {path}: {error.strerror}", hint="make a service with: rse-pf service new NAME"
        ) from error
    except ValueError as error:
        raise UsageError(f"{path} is not JSON: {error}", hint="mend the file") from error
    if not isinstance(told, dict) or not {"name", "language", "entry"} <= set(told) <= _FIELDS:
        raise UsageError(
            f"{path} must have name, language and entry, and may have kind",
            hint='write {"name": "icp", "language": "python", "entry": "service.py"}',
        )
    return _checked(folder, path, told)


def install(folder: Path, into: Path) -> InstalledService:
    """Copy the service in *folder* below *into* and pin every file; an older copy is replaced.

    Raises:
        UsageError: The folder is no service, or its entry is not there (a library that was not built).
    """
    service = read_service(folder)
    if not service.entry_path.is_file():
        built = "build it first: cmake -B build && cmake --build build" if service.language == "cpp" else ""
        raise UsageError(
            f"{service.name}: {service.entry_path} is missing", hint=built or "mend entry in service.json"
        )
    into.mkdir(parents=True, exist_ok=True)
    fresh, old, place = (into / f"{mark}{service.name}" for mark in (".new-", ".old-", ""))
    for leftover in (fresh, old):
        shutil.rmtree(leftover, ignore_errors=True)
    shutil.copytree(folder, fresh, ignore=lambda _, names: _LEFT_OUT & set(names))
    pins = {path: _sha256(fresh / path) for path in _files(fresh)}
    (fresh / _PINS).write_text(json.dumps(pins, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    if place.exists():
        place.rename(old)
    fresh.rename(place)
    shutil.rmtree(old, ignore_errors=True)
    return read_service(place)


def installed_services(folder: Path) -> list[InstalledService]:
    """Return the services installed below *folder*, sorted by name, every file checked against its pin.

    Raises:
        ConfigurationError: The folder is missing, or a file was changed, added or removed since.
    """
    if not folder.is_dir():
        raise ConfigurationError(
            f"there is no services folder {folder}", hint="install one with: rse-pf service install NAME"
        )
    found = []
    for place in sorted(folder.iterdir()):
        if place.is_dir() and not place.name.startswith("."):
            _check_pins(place)
            found.append(read_service(place))
    return found


def published_services() -> list[InstalledService]:
    """Return the services that installed Python packages publish; no package is imported for that.

    The module holds ``serve`` or ``Service``, as a service folder's file does.

    Raises:
        ConfigurationError: A name is none, or published twice.
    """
    found: dict[str, InstalledService] = {}
    for point in metadata.entry_points(group=ENTRY_POINTS):
        if not _NAME.fullmatch(point.name) or point.name in found:
            raise ConfigurationError(
                f"the service {point.name!r} of {point.value} has a bad name, or one that is taken",
                hint="uninstall the package, or set services.published to false",
            )
        top = point.value.partition(".")[0]
        spec = importlib.util.find_spec(top)
        folder = Path(spec.origin).parent if spec is not None and spec.origin else Path()
        found[point.name] = InstalledService(
            name=point.name, language=_PACKAGE, entry=point.value, kind="per_robot_state", folder=folder
        )
    return sorted(found.values(), key=lambda service: service.name)


def _checked(folder: Path, path: Path, told: dict[str, Any]) -> InstalledService:
    name, language, entry = told["name"], told["language"], told["entry"]
    kind = told.get("kind", "stateless")
    wrong = None
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        wrong = f"name {name!r} is not made of 1 to 40 small letters, digits, - and _"
    elif language not in LANGUAGES:
        wrong = f"language {language!r} is not one of {', '.join(LANGUAGES)}"
    elif kind not in _KINDS:
        wrong = f"kind {kind!r} is not one of {', '.join(_KINDS)}"
    elif not isinstance(entry, str) or not entry or Path(entry).is_absolute() or ".." in Path(entry).parts:
        wrong = f"entry {entry!r} is not a file inside the folder"
    if wrong:
        raise UsageError(f"{path}: {wrong}", hint="mend the file")
    return InstalledService(name=name, language=language, entry=entry, kind=kind, folder=folder.absolute())


def _check_pins(place: Path) -> None:
    try:
        pins = json.loads((place / _PINS).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{place} was not installed: {error}", hint="install it with: rse-pf service install FOLDER"
        ) from error
    now = set(_files(place)) - {_PINS}
    changed = [path for path in sorted(now & set(pins)) if _sha256(place / path) != pins[path]]
    changed += [f"{path} (added)" for path in sorted(now - set(pins))]
    changed += [f"{path} (removed)" for path in sorted(set(pins) - now)]
    if changed:
        raise ConfigurationError(
            f"{place.name} was changed after it was installed: {', '.join(changed[:5])}",
            hint="install it again with: rse-pf service install FOLDER",
        )


def _files(folder: Path) -> Iterator[str]:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            yield str(path.relative_to(folder))


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
