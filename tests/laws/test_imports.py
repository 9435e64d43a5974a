"""The order of imports that `.importlinter` describes is kept, and a robot needs three packages only."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

# The module of a robot's socket subclasses picows, which servers install; they alone import it.
IMPORT_ALL = """
import importlib, pkgutil, sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if not (top in installed or top in sys.stdlib_module_names or top.startswith("_sysconfigdata")):
            raise ModuleNotFoundError(f"{name} is not installed")

installed = set(sys.argv[1:])
sys.meta_path.insert(0, Missing())
for name in ("rse_pf", "client_sdk", "lambda_pnp", "ros_bridge"):
    package = importlib.import_module(name)
    for module in pkgutil.walk_packages(package.__path__, f"{name}."):
        if not module.name.endswith((".__main__", ".gateway.websocket")):
            importlib.import_module(module.name)
"""


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the packages of *folder* by the contracts in it."""
    pytest.importorskip("importlinter", reason="run make setup")
    return subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache", "--no-logo"],
        cwd=folder, env={**os.environ, "COLUMNS": "200"}, capture_output=True, text=True, check=False,
    )  # fmt: skip


def import_all(folder: Path, *installed: str) -> subprocess.CompletedProcess[str]:
    """Import every module of *folder* in a process in which only some packages of others are installed."""
    own = ("rse_pf", "client_sdk", "lambda_pnp", "ros_bridge")
    return subprocess.run(
        [sys.executable, "-c", IMPORT_ALL, *own, *installed],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_the_sources_keep_the_contracts(repository: Path) -> None:
    done = lint_imports(repository)

    assert done.returncode == 0, done.stdout + done.stderr


def test_every_module_is_imported_with_what_a_robot_installs(repository: Path) -> None:
    done = import_all(repository, "numpy", "websockets", "msgspec")

    assert done.returncode == 0, done.stderr
