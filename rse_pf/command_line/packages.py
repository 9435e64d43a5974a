"""Find the defect of an installed package: a wrong version, a second package in its folder, or a failing use.

The required versions are those in the metadata of rse-pf.  A package is imported and called once, since a
damaged package, or a folder of the same name that hides it, can often be imported without an error.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import io
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

__all__ = ["Defect", "find_defect", "find_misuse"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Defect:
    """What is wrong with a package.

    ``fix`` is the shell command that repairs it; "" if it is not installed, and its extra has to be
    installed.
    """

    problem: str
    fix: str = ""


def find_defect(module: str, package: str) -> Defect | None:
    """Return the defect of *module*, which *package* installs; None if it has none.

    Checked in this order: whether the module can be found, is installed by this package alone, has a required
    version, and works (`find_misuse`).
    """
    if importlib.util.find_spec(module) is None:
        return Defect(problem=f"{module} cannot be imported")
    installed = {name: metadata.version(name) for name in _owners_of().get(module, ())}
    # Python 3.10 does not list every package with its modules: look this one up by its name, too.
    with contextlib.suppress(metadata.PackageNotFoundError):
        installed[package] = metadata.version(package)
    named = [f"{name} {version}" for name, version in sorted(installed.items())]
    others = sorted(installed.keys() - {package})
    wanted = _declared().get(package, "")
    remove = f"pip uninstall --yes {' '.join(others)} && " if others else ""
    if others and package in installed:
        problem = f"{' and '.join(named)} both install {module}"
        return Defect(problem=problem, fix=f"{remove}{_reinstall(package)}")
    if not all(_is_in(version, wanted) for version in installed.values()):
        problem = f"{', '.join(named)} is installed, and {package}{wanted} is required"
        return Defect(problem=problem, fix=f"{remove}pip install '{package}{wanted}'")
    return find_misuse(module, package)


def find_misuse(module: str, package: str) -> Defect | None:
    """Import *module* and make one small call of it; return the defect if that fails, else None."""
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # numpy prints a page for an extension of another ABI
            made = importlib.import_module(module)
            _CALLS.get(module, _no_call)(made)
    except ModuleNotFoundError as error:
        return Defect(problem=f"{error.name or module} cannot be imported")
    except Exception as error:  # noqa: BLE001 - a damaged package may raise anything
        spec = importlib.util.find_spec(module)
        place = "" if spec is None else [*(spec.submodule_search_locations or ()), spec.origin or ""][0]
        cause = (str(error).splitlines() or [""])[0][:200]
        problem = f"{module} in {place} does not work: {type(error).__name__}: {cause}"
        remove = "" if _is_part_of(package, place) else f"rm -r '{place}'; "
        return Defect(problem=problem, fix=f"{remove}{_reinstall(package)}")
    return None


def _reinstall(package: str) -> str:
    return f"pip install --force-reinstall --no-deps '{package}{_declared().get(package, '')}'"


def _is_part_of(package: str, place: str) -> bool:
    """Return whether the path *place* is where *package* is installed, so that pip replaces it."""
    try:
        return Path(str(metadata.distribution(package).locate_file(Path(place).name))) == Path(place)
    except metadata.PackageNotFoundError:
        return False


def _no_call(module: Any) -> None:
    pass


def _detect_features(cv2: Any) -> None:
    import numpy as np

    cv2.ORB_create(8).detectAndCompute(np.zeros((64, 64), np.uint8), None)


_CALLS: Mapping[str, Callable[[Any], object]] = {
    "numpy": lambda numpy: numpy.linalg.inv(numpy.eye(2)),
    "websockets": lambda websockets: websockets.connect,
    "msgspec": lambda msgspec: msgspec.json.decode(msgspec.json.encode([1])),
    "uvloop": lambda uvloop: uvloop.new_event_loop().close(),
    "httptools": lambda httptools: httptools.parse_url(b"/"),
    "lupa": lambda lupa: lupa.LuaRuntime().eval("1"),
    "prometheus_client": lambda prometheus_client: prometheus_client.CollectorRegistry(),
    "jwt": lambda jwt: jwt.encode({}, "k" * 32, algorithm="HS256"),
    "cv2": _detect_features,
    "h5py": lambda h5py: h5py.File("unused", "w", driver="core", backing_store=False).close(),
    "yaml": lambda yaml: yaml.safe_load("[1]"),
    "gtsam": lambda gtsam: gtsam.Pose3(),
    "onnxruntime": lambda onnxruntime: onnxruntime.get_available_providers(),
    "pyrealsense2": lambda pyrealsense2: pyrealsense2.config(),
    **{
        module: functools.partial(lambda name, _: importlib.import_module(name), f"{module}.{part}")
        for module, part in (
            ("isal", "isal_zlib"), ("packaging", "version"), ("PIL", "Image"), ("rich", "progress"),
            ("cryptography", "hazmat.primitives.asymmetric.ed25519"), ("mcap", "writer"),
            ("rosbags", "rosbag1"), ("matplotlib", "figure"),
        )
    },
}  # fmt: skip
"""For each module, a function that is called with it: a small use, or an import, of its compiled parts."""


@functools.cache
def _owners_of() -> Mapping[str, list[str]]:
    """Return, for each module, the names of the installed distributions that contain it."""
    owners = metadata.packages_distributions()
    return {module: [_normal(name) for name in names if name] for module, names in owners.items()}


@functools.cache
def _declared() -> dict[str, str]:
    """Return the required versions of each package, such as ``>=4.10,<5``, by its normal name.

    Empty if rse-pf itself is not installed, and so has no metadata.
    """
    try:
        lines = metadata.requires("rse-pf") or []
    except metadata.PackageNotFoundError:
        return {}
    parts = (re.match(r"([A-Za-z0-9._-]+)(?:\[[^]]*\])?\s*\(?([^;)]*)", line) for line in lines)
    return {_normal(part[1]): part[2].strip() for part in parts if part}


def _normal(name: str) -> str:
    """Return the package name *name* in its normal form (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _is_in(version: str, wanted: str) -> bool:
    """Return whether *version* meets the requirement *wanted*; only ``>=``, ``<`` and ``==`` count."""
    number = _number(version)
    for operator, limit in re.findall(r"(>=|==|<)\s*([^,\s]+)", wanted):
        bound = _number(limit)
        if (operator == ">=" and number < bound) or (operator == "<" and number >= bound):
            return False
        if operator == "==" and version != limit:
            return False
    return True


def _number(version: str) -> list[int]:
    """Return the numbers of the release in *version*, without zeros at the end: ``4.10.0rc1`` is [4, 10]."""
    release = re.match(r"[0-9]+(?:\.[0-9]+)*", version)
    number = [int(part) for part in release[0].split(".")] if release else []
    while number and number[-1] == 0:
        number.pop()
    return number
