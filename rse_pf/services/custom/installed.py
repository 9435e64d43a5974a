"""Services that the operator installs: one folder each, in Python, C/C++ or Lua, pinned by file hashes.

Robots do not send code: a server runs what is in its services folder, and refuses a folder that was changed
after it was installed.  Nothing of a service is executed here.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.service import Kind
from rse_pf.services.custom.dependencies import (
    Dependencies,
    check_dependencies,
    check_together,
    copy_dependencies,
    read_lock,
)
from rse_pf.services.custom.plain_files import copy_plain, read_plain

__all__ = [
    "DEPENDENCIES_FOLDER",
    "ENTRY_POINTS",
    "InstalledService",
    "check_installed",
    "dependencies_of",
    "identity_of",
    "install",
    "installed_services",
    "published_services",
    "read_service",
]

_Language = Literal["python", "cpp", "lua"]

ENTRY_POINTS = "rse_pf.services"
"""Entry-point group by which Python packages publish services: ``name = "package.module"``."""

_MANIFEST, _PINS, _DEPENDENCIES = "service.json", "pins.json", "dependencies.json"
DEPENDENCIES_FOLDER = ".dependencies"
"""Folder beside the services: their packages, each set named by its digest."""
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_IGNORED = {
    "__pycache__", ".git", ".pytest_cache", "requests", "tests", _PINS, _DEPENDENCIES,
    "CMakeFiles", "CMakeCache.txt", "cmake_install.cmake", "Makefile",
}  # fmt: skip
"""Not installed: recorded requests, tests and temporary files of a build."""


class _Manifest(msgspec.Struct, forbid_unknown_fields=True):
    name: Annotated[str, msgspec.Meta(pattern=rf"^{_NAME.pattern}\Z")]
    language: _Language
    entry: Annotated[str, msgspec.Meta(min_length=1)]
    kind: Literal["stateless", "per_robot_state"] = "stateless"


@dataclass(frozen=True, slots=True, kw_only=True)
class InstalledService:
    """One service folder.

    ``entry`` is the file that is run: a Python or Lua source, or a shared library; for a service that a
    Python package publishes (language ``package``) it is the module's dotted name.  A command to a
    ``stateless`` service may be retried in another sandbox; a ``per_robot_state`` one keeps state as long
    as the robot is connected.  ``dependencies`` is the folder of its own Python packages; ``identity`` is the
    SHA-256 of all that was installed, its packages included, and empty for a folder that was only read.
    """

    name: str
    language: str
    entry: str
    kind: Kind
    folder: Path
    dependencies: Path | None = None
    identity: str = ""

    @property
    def entry_path(self) -> Path:
        """Path of the file that is run."""
        return self.folder / self.entry


def read_service(folder: Path) -> InstalledService:
    """Return the service that ``service.json`` in *folder* describes.

    Raises:
        UsageError: It is missing, is not JSON, or has an invalid field.
    """
    path = folder / _MANIFEST
    try:
        manifest = msgspec.json.decode(read_plain(path), type=_Manifest)
    except OSError as error:
        raise UsageError(
            f"cannot read {path}: {error.strerror}", hint="make a service with: rse-pf service new NAME"
        ) from error
    except msgspec.DecodeError as error:
        raise UsageError(
            f"{path} is not the description of a service: {error}",
            hint='write {"name": "icp", "language": "python", "entry": "service.py"}',
        ) from error
    if Path(manifest.entry).is_absolute() or ".." in Path(manifest.entry).parts:
        raise UsageError(
            f"{path}: entry {manifest.entry!r} is not a file inside the folder", hint="correct the file"
        )
    return InstalledService(**msgspec.structs.asdict(manifest), folder=folder.absolute())


def install(folder: Path, into: Path, dependencies: Dependencies | None = None) -> InstalledService:
    """Copy the service in *folder* below *into* and pin every file; an older copy is replaced.

    Args:
        folder: The service.
        into: The services folder.
        dependencies: The packages that `build_dependencies` installed for it; they are copied, too.

    Raises:
        UsageError: The folder is not a service, holds a link, its entry is missing (a library that was not
            built), or it locks packages and *dependencies* is None.
        ConfigurationError: An installed service needs another version of one of the packages.
    """
    service = read_service(folder)
    if not service.entry_path.is_file():
        built = "build it first: cmake -B build && cmake --build build" if service.language == "cpp" else ""
        raise UsageError(
            f"{service.name}: {service.entry_path} is missing", hint=built or "correct entry in service.json"
        )
    if dependencies is None and read_lock(folder):
        raise UsageError(
            f"the packages of {service.name} are not installed", hint=f"rse-pf service build {folder}"
        )
    into.mkdir(parents=True, exist_ok=True)
    if dependencies is not None:
        others = {name: each for name, each in _dependencies_in(into) if name != service.name}
        check_together({**others, service.name: dependencies})
        copy_dependencies(dependencies, into / DEPENDENCIES_FOLDER)
    fresh, old, target = (into / f"{mark}{service.name}" for mark in (".new-", ".old-", ""))
    for leftover in (fresh, old):
        shutil.rmtree(leftover, ignore_errors=True)
    try:
        copy_plain(folder, fresh, _IGNORED)
    except UsageError:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    if dependencies is not None:
        document = asdict(dependencies) | {"folder": None}
        (fresh / _DEPENDENCIES).write_text(
            json.dumps(document, indent=1, sort_keys=True) + "\n", encoding="utf-8"
        )
    pins = {path: _sha256(fresh / path) for path in _files(fresh)}
    (fresh / _PINS).write_text(json.dumps(pins, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    if target.exists():
        target.rename(old)
    fresh.rename(target)
    shutil.rmtree(old, ignore_errors=True)
    return _read_installed(target)


def installed_services(folder: Path) -> list[InstalledService]:
    """Return the services installed below *folder*, sorted by name, every file checked against its pin.

    Raises:
        ConfigurationError: The folder is missing, a file of a service or of its packages was changed, added
            or removed, or two services need different versions of one package.
    """
    if not folder.is_dir():
        raise ConfigurationError(
            f"there is no services folder {folder}",
            hint=f"install one there: rse-pf service install FOLDER --services {folder}",
        )
    found = []
    for target in sorted(folder.iterdir()):
        if target.is_dir() and not target.name.startswith("."):
            check_installed(target)
            found.append(_read_installed(target))
    built = dict(_dependencies_in(folder))
    for name, dependencies in built.items():
        check_dependencies(dependencies, name)
    check_together(built)
    return found


def published_services() -> list[InstalledService]:
    """Return the services that installed Python packages publish; the packages are not imported.

    The module defines ``serve`` or ``Service``, like the file of a service folder.

    Raises:
        ConfigurationError: A name is invalid or published twice.
    """
    found: dict[str, InstalledService] = {}
    for point in metadata.entry_points(group=ENTRY_POINTS):
        if not _NAME.fullmatch(point.name) or point.name in found:
            raise ConfigurationError(
                f"the service {point.name!r} of {point.value} has an invalid name, or one that is in use",
                hint="uninstall the package, or set services.published to false",
            )
        top = point.value.partition(".")[0]
        spec = importlib.util.find_spec(top)
        folder = Path(spec.origin).parent if spec is not None and spec.origin else Path()
        found[point.name] = InstalledService(
            name=point.name, language="package", entry=point.value, kind="per_robot_state", folder=folder
        )
    return sorted(found.values(), key=lambda service: service.name)


def _read_installed(target: Path) -> InstalledService:
    service, dependencies = read_service(target), dependencies_of(target)
    return replace(
        service,
        dependencies=None if dependencies is None else dependencies.folder,
        identity=identity_of(target),
    )


def _dependencies_in(folder: Path) -> Iterator[tuple[str, Dependencies]]:
    """Yield name and packages of every installed service that has some."""
    for target in sorted(folder.iterdir()):
        dependencies = None if target.name.startswith(".") else dependencies_of(target)
        if dependencies is not None:
            yield target.name, dependencies


def dependencies_of(target: Path) -> Dependencies | None:
    """Return the packages of the service that is installed in *target*, None if it has none.

    Raises:
        ConfigurationError: The record of them is damaged.
    """
    path = target / _DEPENDENCIES
    if not path.is_file() or not (target / _PINS).is_file():
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        digest = str(document["digest"])
        if not _DIGEST.fullmatch(digest):
            raise ValueError("its digest is none")
        return Dependencies(**{**document, "folder": target.parent.absolute() / DEPENDENCIES_FOLDER / digest})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"{path} is damaged: {error!r}", hint="install it again with: rse-pf service install FOLDER"
        ) from error


def identity_of(target: Path) -> str:
    """Return the `InstalledService.identity` of what is installed in *target*; raises OSError."""
    return _sha256(target / _PINS)


def check_installed(target: Path) -> None:
    """Check that *target* holds the files of an installed service, as they were installed.

    Raises:
        ConfigurationError: It was not installed, or a file was changed, added or removed.
    """
    try:
        pins = json.loads((target / _PINS).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{target} was not installed: {error}", hint="install it with: rse-pf service install FOLDER"
        ) from error
    present = set(_files(target)) - {_PINS}
    changed = [path for path in sorted(present & set(pins)) if _sha256(target / path) != pins[path]]
    changed += [f"{path} (added)" for path in sorted(present - set(pins))]
    changed += [f"{path} (removed)" for path in sorted(set(pins) - present)]
    if changed:
        raise ConfigurationError(
            f"{target.name} was changed after it was installed: {', '.join(changed[:5])}",
            hint="install it again with: rse-pf service install FOLDER",
        )


def _files(folder: Path) -> Iterator[str]:
    for path in sorted(folder.rglob("*")):
        if (path.is_file() or path.is_symlink()) and "__pycache__" not in path.parts:
            yield str(path.relative_to(folder))


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
