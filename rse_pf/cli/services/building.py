"""Lock the Python packages of a service, and build a service: rse-pf service lock and service build.

The actions test, run, install and publish build a service first, too.  C and C++ are compiled with cmake; the
Python packages in the service's lock are installed once.
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
    """The argument that names the folder of a service."""

    folder: Path = option(metavar="FOLDER", help="folder of the service")


def lock_service(request: FolderRequest, settings: PlatformSettings) -> None:
    """Write the lock of a service's Python packages, and print the chosen version of each."""
    source = request.folder
    _check_language(read_service(source))
    with at_work("resolving versions"):
        chosen = lock_dependencies(source)
    for each in chosen:
        show(f"{each.name}=={each.version}")
    show(f"{counted(len(chosen), 'package')} locked for {platform_tag()} in {source / LOCK_FILE}")


def build_service(request: FolderRequest, settings: PlatformSettings) -> None:
    """Build a service, and print the Python packages that were installed for it."""
    service, dependencies = built_service(request.folder)
    if dependencies is None:
        show(f"{service.name} has no packages of its own")
        return
    listed = ", ".join(f"{name} {version}" for name, version in sorted(dependencies.packages.items()))
    show(f"{service.name} has {listed}", f"digest {dependencies.digest[:16]}, in {dependencies.folder}")


def built_service(source: Path) -> tuple[InstalledService, Dependencies | None]:
    """Build the service in the folder *source*; return it and its Python packages, None if it has none.

    Raises:
        UsageError: The folder holds no valid service or lock, or cmake is not installed.
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
    """Return when a file in *folder*, of a service, was last changed, in Unix time.

    Built files, recorded requests and bytecode of Python do not count.
    """
    return max(_mtimes(folder))


def _store() -> Path:
    """Return the folder in which packages are installed, next to those of platforms.

    No platform can have its name, which begins with a dot.
    """
    return state_folder("default", os.environ).parent / ".dependencies"


def _check_language(service: InstalledService) -> None:
    """Raise UsageError if *service* is not in Python, the only language with a lock."""
    if service.language != "python":
        raise UsageError(
            f"{LOCK_FILE} is for services in Python, {service.name} is in {service.language}",
            hint="remove the file, and put libraries into the folder of the service",
        )


def _compile(folder: Path) -> None:
    """Compile the service in *folder* with cmake, if it has a CMakeLists.txt and is not up to date.

    Its CMakeLists.txt finds the header of this version's C interface in the folder ``RSE_PF_INCLUDE``.

    Raises:
        UsageError: cmake is not installed.
        CommandFailed: cmake failed; the end of its output is in the message.
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
    """Yield the time of the last change of each source file of a service, in Unix time."""
    for path in folder.rglob("*"):
        inside = path.relative_to(folder).parts
        if path.is_file() and inside[0] not in ("build", "requests") and "__pycache__" not in inside:
            yield path.stat().st_mtime
