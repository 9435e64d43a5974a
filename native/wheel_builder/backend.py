"""The build backend of ``native/pyproject.toml`` (PEP 517): compile the library, check it, pack it.

The wheel is for every Python and one machine (``py3-none-manylinux_2_28_MACHINE``), and holds the library and
a module by which it is found.  A library that would not load on an older system is not packed.
"""

from __future__ import annotations

import base64
import hashlib
import os
import platform
import re
import shlex
import shutil
import subprocess
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .elf import NEWEST_GLIBC, ElfError, complaints, read_library

NATIVE = Path(__file__).resolve().parents[1]
LIBRARY = "librse_pf_native.so"
_COMPILERS = ("c++", "g++", "clang++")
_EARLIEST = (1980, 1, 1, 0, 0, 0)
_MODULE = '''"""The native core of RSE-PF; `rse_pf.native` loads the library beside this file."""\n'''


class BuildError(Exception):
    """There is no wheel; ``hint`` says what to do."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


def build_wheel(
    wheel_directory: str,
    config_settings: Mapping[str, Any] | None = None,
    metadata_directory: str | None = None,
) -> str:
    """Build the wheel for this machine into *wheel_directory* and return its name, as PEP 517 asks."""
    settings = config_settings or {}
    machine = settings.get("machine", platform.machine())
    try:
        return built_wheel(Path(wheel_directory), machine, settings.get("compiler")).name
    except BuildError as error:
        raise SystemExit(f"native: {error}\n  hint: {error.hint}") from error


def built_wheel(into: Path, machine: str, compiler: str | None = None) -> Path:
    """Compile for *machine* and return the wheel in *into*.

    Raises:
        BuildError: There is no compiler, it failed, or its library may not be shipped.
    """
    return pack(compiled(machine, compiler), machine, into)


def compiled(machine: str, compiler: str | None = None) -> Path:
    """Return the library for *machine*; compiles only what has changed.

    Raises:
        BuildError: There is no compiler, or it failed.
    """
    is_own = machine == platform.machine()
    compiler = compiler or os.environ.get("CXX") or (_own_compiler() if is_own else None)
    if compiler is None:
        raise BuildError(
            f"no C++ compiler for {machine}",
            "install g++, or pass --compiler" if is_own else "pass --compiler: the wheel ziglang holds one",
        )
    out = NATIVE / "build" / ("" if is_own else machine)
    command = ["make", "-C", str(NATIVE), f"OUT={out}", f"ARCH={machine}", f"CXX={compiler}"]
    try:
        made = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise BuildError("no make", "install make") from error
    if made.returncode:
        lines = made.stderr.strip().splitlines()
        first = next((line for line in lines if "error" in line.lower()), "no message")
        raise BuildError(f"{compiler} failed: {first}", f"run it yourself: {shlex.join(command)}")
    return out / LIBRARY


def pack(library: Path, machine: str, into: Path) -> Path:
    """Check *library* and return the wheel that holds it.

    Raises:
        BuildError: It would not load on an older system, or on no system.
    """
    data = library.read_bytes()
    try:
        wrong = complaints(read_library(data), machine)
    except ElfError as error:
        wrong = [str(error)]
    if wrong:
        raise BuildError(f"{library} may not be shipped: {'; '.join(wrong)}", "see native/Makefile")
    version = _project("version")
    tag = f"py3-none-manylinux_{NEWEST_GLIBC[0]}_{NEWEST_GLIBC[1]}_{machine}"
    information = f"rse_pf_native-{version}.dist-info"
    files = {
        "rse_pf_native/__init__.py": _MODULE.encode(),
        f"rse_pf_native/{LIBRARY}": data,
        f"{information}/METADATA": (
            f"Metadata-Version: 2.4\nName: rse-pf-native\nVersion: {version}\n"
            f"Summary: {_project('description')}\nLicense-Expression: {_project('license')}\n"
            f"License-File: LICENSE\nRequires-Python: {_project('requires-python')}\n"
            f"Description-Content-Type: text/markdown\n\n{_text(NATIVE / 'README.md')}"
        ).encode(),
        f"{information}/licenses/LICENSE": _text(NATIVE.parent / "LICENSE").encode(),
        f"{information}/WHEEL": (
            f"Wheel-Version: 1.0\nGenerator: rse-pf wheel_builder\nRoot-Is-Purelib: false\nTag: {tag}\n"
        ).encode(),
    }
    record = "".join(f"{name},sha256={_digest(held)},{len(held)}\n" for name, held in files.items())
    files[f"{information}/RECORD"] = f"{record}{information}/RECORD,,\n".encode()
    into.mkdir(parents=True, exist_ok=True)
    wheel = into / f"rse_pf_native-{version}-{tag}.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, held in files.items():
            entry = zipfile.ZipInfo(name, _EARLIEST)
            entry.external_attr = (0o100755 if name.endswith(".so") else 0o100644) << 16
            archive.writestr(entry, held, zipfile.ZIP_DEFLATED, 9)
    return wheel


def _own_compiler() -> str | None:
    return next((each for each in _COMPILERS if shutil.which(each)), None)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise BuildError(
            f"{path} cannot be read: {error.strerror}", "build it in a checkout: the wheel holds the licence"
        ) from error


def _project(field: str) -> str:
    """Return *field* of the project's table; Python 3.10 has no parser of TOML."""
    found = re.search(rf'^{field} = "(.+)"$', _text(NATIVE / "pyproject.toml"), re.M)
    assert found is not None, field
    return found[1]


def _digest(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
