"""Each extension can be removed: neither the core nor its tests import one when they are loaded."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXTENSIONS = ("rse_pf.extensions", "client_sdk.bags", "client_sdk.check", "ros_bridge")
TESTS_OF_EXTENSIONS = (
    "batch", "check", "cli/maps/test_bags.py", "client_sdk/bags", "client_sdk/check", "costs", "experiments",
    "fleet_page", "map_export", "recording", "ros_bridge", "rosbridge", "system/demo",
)  # fmt: skip
"""Folders and files below ``tests`` that are removed with an extension."""

IMPORT_CORE = """
import importlib, pkgutil, sys

class Removed:
    def find_spec(self, name, path=None, target=None):
        if is_extension(name):
            raise ModuleNotFoundError(f"{name} was removed", name=name)

def is_extension(name):
    return any(name == each or name.startswith(each + ".") for each in sys.argv[1:])

sys.meta_path.insert(0, Removed())
for name in ("rse_pf", "client_sdk", "lambda_pnp"):
    package = importlib.import_module(name)
    for module in pkgutil.walk_packages(package.__path__, f"{name}."):
        if not is_extension(module.name) and not module.name.endswith(".__main__"):
            importlib.import_module(module.name)
"""


def imports_of(file: Path) -> set[str]:
    """Return the modules that *file* imports when it is loaded; *from a import b* gives *a* and *a.b*."""
    names = set()
    for node in ast.parse(file.read_bytes()).body:
        if isinstance(node, ast.Import):
            names |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{each.name}" for each in node.names)}
    return names


def needs_extension(file: Path, tests: Path) -> bool:
    """Return whether *file*, or a helper of ``tests/kit`` that it imports, imports an extension."""
    names = imports_of(file)
    if any(f"{name}.".startswith(f"{each}.") for name in names for each in EXTENSIONS):
        return True
    helpers = (
        tests / "kit" / f"{name.rpartition('.')[2]}.py" for name in names if name.startswith("tests.kit.")
    )
    return any(needs_extension(helper, tests) for helper in helpers if helper.is_file())


@pytest.mark.system
def test_every_module_of_the_core_is_imported_without_the_extensions(repository: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_CORE, *EXTENSIONS],
        cwd=repository, env={**os.environ, "PYTHONPATH": str(repository)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip

    assert done.returncode == 0, done.stderr


def test_tests_of_the_core_import_no_extension(repository: Path) -> None:
    tests = repository / "tests"
    of_extensions = {
        file for each in TESTS_OF_EXTENSIONS for file in (tests / each, *(tests / each).rglob("*"))
    }
    of_core = {*tests.rglob("test_*.py"), *tests.rglob("conftest.py")} - of_extensions

    assert [str(file.relative_to(tests)) for file in of_core if needs_extension(file, tests)] == []
