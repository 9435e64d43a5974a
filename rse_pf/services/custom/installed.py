"""Read, install and verify the folders of services; ``pins.json`` holds the SHA-256 of every installed file.

A server runs the services in its services folder, and refuses one whose files were changed after the
installation.
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
    SHA256_PATTERN,
    Dependencies,
    copy_dependencies,
    read_lock,
    require_same_versions,
    verify_dependencies,
)
from rse_pf.services.custom.regular_files import copy_regular_files, list_files, read_regular_file

__all__ = [
    "DEPENDENCIES_FOLDER",
    "ENTRY_POINTS",
    "NAME_PATTERN",
    "InstalledService",
    "install",
    "installed_services",
    "packaged_services",
    "read_dependencies",
    "read_identity",
    "read_service",
    "verify_installed",
]

_Language = Literal["python", "cpp", "lua"]

ENTRY_POINTS = "rse_pf.services"
"""Entry-point group by which installed Python packages offer services: ``name = "package.module"``."""

_MANIFEST = "service.json"  # file in which the author describes the service
_PINS = "pins.json"  # file of an installed service with the SHA-256 of every other file
_DEPENDENCIES = "dependencies.json"  # file of an installed service that names its Python packages
DEPENDENCIES_FOLDER = ".dependencies"
"""Folder in a services folder that holds the Python packages of services, each set in a folder named by its
digest."""
NAME_PATTERN = re.compile(r"[a-z][a-z0-9_-]{0,39}")  # the name of a service
_IGNORED = {
    "__pycache__",
    ".git",
    ".pytest_cache",
    "requests",
    "tests",
    _PINS,
    _DEPENDENCIES,
    "CMakeFiles",
    "CMakeCache.txt",
    "cmake_install.cmake",
    "Makefile",
}
"""Names of files and folders that are not installed: recorded requests, tests, and temporary files of a
build."""


class _Manifest(msgspec.Struct, forbid_unknown_fields=True):
    """The content of ``service.json``."""

    name: Annotated[str, msgspec.Meta(pattern=rf"^{NAME_PATTERN.pattern}\Z")]
    language: _Language
    entry: Annotated[str, msgspec.Meta(min_length=1)]
    kind: Literal["stateless", "per_robot_state"] = "stateless"


@dataclass(frozen=True, slots=True, kw_only=True)
class InstalledService:
    """A service that can be loaded.

    Attributes:
        name: Name by which robots call the service.
        language: ``python``, ``cpp`` or ``lua``; ``package`` for a service of an installed Python package.
        entry: File that is loaded, relative to *folder*: a Python or Lua source, or a shared library.  For
            the language ``package`` the dotted name of the module.
        kind: ``stateless``: the service keeps no state between commands, so that a command whose sandbox
            crashed is retried in another one.  ``per_robot_state``: the service keeps state of the robot in
            its sandbox; the state outlives the sandbox, and a command is retried, only if the service has
            snapshots.
        folder: Folder of the service.
        dependencies: Folder of the service's own Python packages; None without any.
        identity: SHA-256 of ``pins.json``, which holds the SHA-256 of every file of the service, also that of
            ``dependencies.json`` with the digest of its packages; so it differs if any installed file
            differs.  Empty for a folder that is not installed.
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
        """Path of the file that is loaded; no path for the language ``package``, whose entry is a module."""
        return self.folder / self.entry


def read_service(folder: Path) -> InstalledService:
    """Return the service that ``service.json`` in *folder* describes.

    Raises:
        UsageError: The file is missing, is not a regular file, is not JSON, has an invalid or unknown field,
            or names an entry outside of the folder.  Whether the entry exists is not checked.
    """
    path = folder / _MANIFEST
    try:
        manifest = msgspec.json.decode(read_regular_file(path), type=_Manifest)
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
    """Copy the service in *folder* to the services folder *into*, and write the hash of every file.

    An installed service of the same name is replaced after the copy is complete: its folder is renamed, the
    copy gets its name, and the renamed folder is deleted.  The Python packages of the replaced service are
    not deleted from the services folder.

    Args:
        folder: The service.
        into: The services folder, which is created if it is missing.
        dependencies: Packages that `build_dependencies` installed for the service, which are copied as well.

    Raises:
        UsageError: The folder is not a service, holds a link, pipe, socket or device, its entry is missing
            (such as a library that was not built), or it locks packages and *dependencies* is None.
        ConfigurationError: An installed service needs another version of a package.
    """
    # 1. Check the folder and the versions of its packages.
    service = read_service(folder)
    if not service.entry_path.is_file():
        is_library = service.language == "cpp"
        raise UsageError(
            f"{service.name}: {service.entry_path} is missing",
            hint="build it first: cmake -B build && cmake --build build"
            if is_library
            else "correct entry in service.json",
        )
    if dependencies is None and read_lock(folder):
        raise UsageError(
            f"the packages of {service.name} are not installed", hint=f"rse-pf service build {folder}"
        )
    into.mkdir(parents=True, exist_ok=True)
    if dependencies is not None:
        packages = {name: installed.packages for name, installed in _dependencies_in(into)}
        require_same_versions({**packages, service.name: dependencies.packages})
        copy_dependencies(dependencies, into / DEPENDENCIES_FOLDER)
    # 2. Copy the folder under a temporary name, write which packages belong to it, and the hash of every
    # file.
    fresh, old, target = (into / f"{prefix}{service.name}" for prefix in (".new-", ".old-", ""))
    for leftover in (fresh, old):
        shutil.rmtree(leftover, ignore_errors=True)
    try:
        copy_regular_files(folder, fresh, _IGNORED)
    except UsageError:
        shutil.rmtree(fresh, ignore_errors=True)
        raise
    if dependencies is not None:
        document = asdict(dependencies) | {"folder": None}
        (fresh / _DEPENDENCIES).write_text(
            json.dumps(document, indent=1, sort_keys=True) + "\n", encoding="utf-8"
        )
    pins = {path: _file_sha256(fresh / path) for path in _list_files(fresh)}
    (fresh / _PINS).write_text(json.dumps(pins, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    # 3. Let the copy take the place of the installed service.
    if target.exists():
        target.rename(old)
    fresh.rename(target)
    shutil.rmtree(old, ignore_errors=True)
    return _read_installed(target)


def installed_services(folder: Path) -> list[InstalledService]:
    """Compare the services in the services folder *folder* with their hashes, and return them sorted by name.

    Folders whose names begin with a dot are no services.

    Raises:
        ConfigurationError: The folder is missing; a file of a service or of its packages was changed, added
            or removed; or two services need different versions of a package.
    """
    if not folder.is_dir():
        raise ConfigurationError(
            f"there is no services folder {folder}",
            hint=f"install one there: rse-pf service install FOLDER --services {folder}",
        )
    services = [
        verify_installed(target)
        for target in sorted(folder.iterdir())
        if target.is_dir() and not target.name.startswith(".")
    ]
    require_same_versions({name: dependencies.packages for name, dependencies in _dependencies_in(folder)})
    return services


def packaged_services() -> list[InstalledService]:
    """Return the services that Python packages offer by entry points; the packages are not imported.

    The module of an entry point defines ``serve`` or ``Service``, like the file of a service folder.  The
    kind of these services is always ``per_robot_state``, and their identity is empty: their files are not
    verified.

    Raises:
        ConfigurationError: The name of an entry point is not a valid name of a service, or two entry points
            have the same name.
    """
    services: dict[str, InstalledService] = {}
    for point in metadata.entry_points(group=ENTRY_POINTS):
        if not NAME_PATTERN.fullmatch(point.name) or point.name in services:
            raise ConfigurationError(
                f"the service {point.name!r} of {point.value} has an invalid name, or one that is in use",
                hint="uninstall the package, or set services.published to false, which runs no service of an "
                "installed Python package",
            )
        spec = importlib.util.find_spec(point.value.partition(".")[0])
        folder = Path(spec.origin).parent if spec is not None and spec.origin else Path()
        services[point.name] = InstalledService(
            name=point.name, language="package", entry=point.value, kind="per_robot_state", folder=folder
        )
    return sorted(services.values(), key=lambda service: service.name)


def _read_installed(target: Path) -> InstalledService:
    service, dependencies = read_service(target), read_dependencies(target)
    return replace(
        service,
        dependencies=None if dependencies is None else dependencies.folder,
        identity=read_identity(target),
    )


def _dependencies_in(folder: Path) -> Iterator[tuple[str, Dependencies]]:
    """Yield name and packages of each service in the services folder *folder* that has packages."""
    for target in sorted(folder.iterdir()):
        dependencies = None if target.name.startswith(".") else read_dependencies(target)
        if dependencies is not None:
            yield target.name, dependencies


def read_dependencies(target: Path) -> Dependencies | None:
    """Return the packages of the installed service in the folder *target*; their files are not verified.

    The result is None if the service has no packages, or if it was not installed: its folder has no
    ``pins.json``.

    Raises:
        ConfigurationError: ``dependencies.json`` is damaged.
    """
    path = target / _DEPENDENCIES
    if not path.is_file() or not (target / _PINS).is_file():
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        digest = str(document["digest"])
        if not SHA256_PATTERN.fullmatch(digest):
            raise ValueError("the digest is not a SHA-256")
        return Dependencies(**{**document, "folder": target.parent.absolute() / DEPENDENCIES_FOLDER / digest})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"{path} is damaged: {error!r}", hint="install it again with: rse-pf service install FOLDER"
        ) from error


def read_identity(target: Path) -> str:
    """Return `InstalledService.identity` of the installed service in the folder *target*.

    Raises:
        OSError: ``pins.json`` is missing or cannot be read.
    """
    return _file_sha256(target / _PINS)


def verify_installed(target: Path) -> InstalledService:
    """Return the installed service in the folder *target*, whose files and packages must be unchanged.

    Files in folders ``__pycache__`` are ignored.

    Raises:
        ConfigurationError: The service was not installed; a file of it or of its Python packages was changed,
            added or removed; or the packages are for another platform.
    """
    try:
        pins = json.loads((target / _PINS).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"{target} was not installed: {error}", hint="install it with: rse-pf service install FOLDER"
        ) from error
    present = set(_list_files(target)) - {_PINS}
    changed = [path for path in sorted(present & set(pins)) if _file_sha256(target / path) != pins[path]]
    changed += [f"{path} (added)" for path in sorted(present - set(pins))]
    changed += [f"{path} (removed)" for path in sorted(set(pins) - present)]
    if changed:
        raise ConfigurationError(
            f"{target.name} was changed after it was installed: {', '.join(changed[:5])}",
            hint="install it again with: rse-pf service install FOLDER",
        )
    dependencies = read_dependencies(target)
    if dependencies is not None:
        verify_dependencies(dependencies, target.name)
    return _read_installed(target)


def _list_files(folder: Path) -> list[str]:
    return [str(path.relative_to(folder)) for path in list_files(folder) if "__pycache__" not in path.parts]


def _file_sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
