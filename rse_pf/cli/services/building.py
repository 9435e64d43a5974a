"""The actions lock and build, and the step before test, run, install and debug: make a service ready to run.

C and C++ are compiled with cmake; Python packages of the service's own are installed once from its lock.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.local.state import state_folder
from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.dependencies import (
    LOCK_FILE,
    Dependencies,
    build_dependencies,
    lock_dependencies,
    platform_tag,
)
from rse_pf.services.custom.installed import InstalledService, read_service
from rse_pf.terminal import at_work, counted, show

__all__ = ["FolderRequest", "build_service", "built_service", "changed_s", "lock_service"]


@dataclass(frozen=True, kw_only=True)
class FolderRequest:
    """The folder of a service."""

    folder: Path = option(metavar="FOLDER", help="folder of the service")


def lock_service(request: FolderRequest, settings: PlatformSettings) -> None:
    """Lock the packages of a service, and show what was chosen."""
    source = request.folder
    _check_language(read_service(source))
    with at_work("resolving versions"):
        chosen = lock_dependencies(source)
    for each in chosen:
        show(f"{each.name}=={each.version}")
    show(f"{counted(len(chosen), 'package')} locked for {platform_tag()} in {source / LOCK_FILE}")


def build_service(request: FolderRequest, settings: PlatformSettings) -> None:
    """Build a service, and show its packages."""
    service, dependencies = built_service(request.folder)
    if dependencies is None:
        show(f"{service.name} has no packages of its own")
        return
    listed = ", ".join(f"{name} {version}" for name, version in sorted(dependencies.packages.items()))
    show(f"{service.name} has {listed}", f"digest {dependencies.digest[:16]}, in {dependencies.folder}")


def built_service(source: Path) -> tuple[InstalledService, Dependencies | None]:
    """Return the service in *source*, ready to run, and its packages, None if it has none.

    Raises:
        UsageError: The folder or its lock is refused, or cmake is missing.
        CommandFailed: The compiler or pip failed.
    """
    service = read_service(source)
    _compile(service.folder)
    if (service.folder / LOCK_FILE).exists():
        _check_language(service)
    with at_work(f"installing the packages of {service.name}"):
        dependencies = build_dependencies(service.folder, _store())
    if dependencies is None:
        return service, None
    return dataclasses.replace(service, dependencies=dependencies.folder), dependencies


def changed_s(folder: Path) -> float:
    """Return when a file of a service was changed last, in Unix time; what is built does not count."""
    return max(_mtimes(folder))


def _store() -> Path:
    """Return where packages are installed; no platform can have this name."""
    return state_folder("default", os.environ).parent / ".dependencies"


def _check_language(service: InstalledService) -> None:
    if service.language != "python":
        raise UsageError(
            f"{LOCK_FILE} is for services in Python, {service.name} is in {service.language}",
            hint="remove the file, and put libraries into the folder of the service",
        )


def _compile(folder: Path) -> None:
    """Build a service that has a CMakeLists.txt and sources newer than its libraries.

    Its CMakeLists.txt may take the C interface of this version from the folder ``RSE_PF_INCLUDE``.
    """
    if not (folder / "CMakeLists.txt").exists():
        return
    libraries = [path.stat().st_mtime for path in (folder / "build").glob("*.so")]
    if libraries and changed_s(folder) <= max(libraries):
        return
    if shutil.which("cmake") is None:
        raise UsageError(
            "cmake is not installed, so the service cannot be built", hint="apt install cmake g++"
        )
    headers = f"-DRSE_PF_INCLUDE={INCLUDE_FOLDER}"
    for command in (["cmake", "-S", ".", "-B", "build", headers], ["cmake", "--build", "build"]):
        with at_work(f"building {folder.name}"):
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            output = (done.stderr or done.stdout).strip()[-1500:]
            raise CommandFailed(f"{' '.join(command)} failed:\n{output}", hint=f"fix the sources in {folder}")
    show(f"built {folder / 'build'}")


def _mtimes(folder: Path) -> Iterator[float]:
    for path in folder.rglob("*"):
        inside = path.relative_to(folder).parts
        if path.is_file() and inside[0] not in ("build", "requests") and "__pycache__" not in inside:
            yield path.stat().st_mtime
