"""The order of imports that `.importlinter` describes is kept, and a robot needs three packages only."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.system

PACKAGES = ("rse_pf", "client_sdk", "lambda_pnp", "ros_bridge", "stacks")
FORBIDDEN = {
    "client_sdk/robot.py": "import rse_pf.backend.gateway.websocket",
    "client_sdk/mapper.py": "from client_sdk import connect",
    "client_sdk/frontend.py": "import cv2",
    "client_sdk/offloading/offload.py": "def now():\n    import time",
    "client_sdk/stats.py": "if TYPE_CHECKING:\n    from rse_pf.auth.tokens import SigningKey",
    "rse_pf/geometry.py": "from .wire import Command",
    "rse_pf/wire/messages.py": "def f():\n    from rse_pf.wire import codec",
    "rse_pf/backend/scheduling/scheduler.py": "from rse_pf.backend.gateway import frames",
    "rse_pf/data_server/app.py": "import boto3",
    "rse_pf/local/control/platform.py": "from rse_pf.backend import supervisor",
    "rse_pf/maps/registry.py": "import gtsam",
    "rse_pf/data_server/server.py": "from websockets.asyncio.client import connect",
    "rse_pf/enrolment.py": "import jwt",
    "lambda_pnp/handler.py": "from rse_pf.scaling import policy",
    "stacks/values.py": "from rse_pf.auth.tokens import verify_token",
}
"""File -> an import that a contract forbids there; together they break every contract."""

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
        if not module.name.endswith(".__main__"):
            importlib.import_module(module.name)
"""


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the packages of *folder* by the contracts in it."""
    pytest.importorskip("importlinter", reason="the dev extra is not installed")
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


@pytest.fixture
def copied(tmp_path: Path, repository: Path) -> Path:
    """A copy of the sources and of their contracts."""
    for name in PACKAGES:
        shutil.copytree(
            repository / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "static")
        )
    shutil.copy(repository / ".importlinter", tmp_path)
    return tmp_path


def test_the_sources_keep_the_contracts(repository: Path) -> None:
    done = lint_imports(repository)

    assert done.returncode == 0, done.stdout + done.stderr


def test_every_contract_finds_an_import_that_it_forbids(copied: Path) -> None:
    for file, line in FORBIDDEN.items():
        source = (copied / file).read_text(encoding="utf-8")
        (copied / file).write_text(f"{source}\n\n{line}\n", encoding="utf-8")

    done = lint_imports(copied)

    assert done.returncode == 1, done.stderr
    assert " 0 kept" in done.stdout, done.stdout
    assert [file for file in FORBIDDEN if f"{Path(file).stem} -> " not in done.stdout] == []


def test_every_module_is_imported_with_what_a_robot_installs(repository: Path) -> None:
    done = import_all(repository, "numpy", "websockets", "msgspec")

    assert done.returncode == 0, done.stderr


def test_an_optional_package_that_a_module_imports_is_noticed(repository: Path) -> None:
    done = import_all(repository, "numpy", "websockets")

    assert "msgspec is not installed" in done.stderr
