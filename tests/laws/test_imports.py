"""The import law: who may import whom, and which packages are let in where."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping

import pytest

GROUND = {"errors", "settings", "names"}
FIRST = {
    "geometry",
    "wire",
    "scaling",
    "auth",
    "enrolment",
    "control",
    "control_token",
    "robot_key",
    "service",
    "objects",
    "maps",
    "audit",
    "audit_log",
    "audit_check",
}
SECOND = {"pnp", "services", "aws"}
LEAVES = {"backend", "data_server", "local", "client_sdk", "lambda_pnp", "stacks"}
BELOW_LEAVES = GROUND | FIRST | SECOND

MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "names": set(),
    "settings": {"errors", "setting_checks"},
    "setting_checks": {"errors"},
    "geometry": GROUND,
    "wire": GROUND,
    "scaling": GROUND,
    "maps": GROUND | {"geometry"},
    "enrolment": GROUND,
    "auth": GROUND | {"enrolment"},
    "objects": GROUND,
    "audit": GROUND,
    "audit_log": GROUND | {"audit"},
    "audit_check": GROUND | {"audit", "audit_log"},
    "robot_key": GROUND | {"auth"},
    "control_token": GROUND,
    "control": GROUND | {"enrolment", "auth", "objects"},
    "service": GROUND | {"wire", "geometry"},
    "pnp": GROUND | FIRST,
    "services": GROUND | FIRST | {"pnp"},
    "aws": GROUND | FIRST | {"pnp", "services"},
    "backend": BELOW_LEAVES - {"scaling"},
    "data_server": BELOW_LEAVES,
    "local": {"settings", "scaling", "errors", "auth", "objects", "audit", "audit_log", "control_token"},
    "client_sdk": {"settings", "errors", "geometry", "maps", "wire", "service", "services", "pnp"},
    "lambda_pnp": BELOW_LEAVES - {"scaling", "aws"},
    "stacks": {"settings", "scaling", "errors", "names"},
    "experiments": BELOW_LEAVES | LEAVES - {"stacks"},
    "cli": BELOW_LEAVES | LEAVES - {"stacks"} | {"experiments"},
    "app": {"settings", "errors", "stacks"},
    "rse_pf": set(),
}

PACKAGES: dict[str, tuple[str, ...]] = {
    "numpy": ("rse_pf/", "client_sdk/", "lambda_pnp/"),
    "msgspec": ("rse_pf/", "client_sdk/", "lambda_pnp/"),
    "websockets": ("client_sdk/connection.py",),
    "cv2": ("rse_pf/pnp/engines.py", "client_sdk/frontend.py", "client_sdk/datasets.py"),
    "h5py": ("client_sdk/datasets.py", "client_sdk/nyu.py"),
    "poselib": ("rse_pf/pnp/engines.py",),
    "picows": ("rse_pf/backend/server.py",),
    "aiofastnet": ("rse_pf/backend/",),
    "uvloop": ("rse_pf/backend/",),
    "prometheus_client": ("rse_pf/backend/", "rse_pf/data_server/"),
    "uvicorn": ("rse_pf/data_server/server.py", "rse_pf/data_server/one_request.py"),
    "jwt": ("rse_pf/auth.py",),
    "cryptography": ("rse_pf/auth.py",),
    "boto3": ("rse_pf/aws/",),
    "botocore": ("rse_pf/aws/",),
    "aws_cdk": ("stacks/", "app.py"),
    "constructs": ("stacks/", "app.py"),
    "jsii": ("stacks/",),
    "cdk_nag": ("stacks/", "app.py"),
    "matplotlib": ("rse_pf/experiments/pictures.py",),
    "PIL": ("rse_pf/experiments/map_picture.py",),
    "viser": ("rse_pf/experiments/map_browser.py",),
    "rich": ("rse_pf/cli/", "rse_pf/experiments/"),
    "lupa": ("rse_pf/services/",),
    "gtsam": ("rse_pf/services/optimise.py",),
    "small_gicp": ("rse_pf/services/icp.py",),
    "faiss": ("rse_pf/services/descriptors.py", "rse_pf/services/place.py"),
    "envoy": ("rse_pf/local/",),
}
BASE = {"numpy", "msgspec", "websockets"}
BASE_ROOMS = MAY_IMPORT["client_sdk"] | {"client_sdk", "setting_checks", "auth", "scaling", "objects"}

PURE = ("rse_pf/wire/", "rse_pf/scaling/", "rse_pf/auth.py", "rse_pf/audit.py", "client_sdk/offload.py")
IMPURE = {
    "time", "datetime", "sched", "socket", "socketserver", "select", "selectors", "ssl", "threading",
    "_thread", "concurrent", "multiprocessing", "subprocess", "random", "secrets", "uuid", "os",
    "signal", "asyncio",
}  # fmt: skip


def room_of(module: str) -> str:
    """Return the room of a dotted module name."""
    first, _, rest = module.partition(".")
    return rest.split(".")[0] if first == "rse_pf" and rest else first


def module_of(path: str) -> str:
    """Return the dotted name of a source file."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imports(path: str, text: str, tree: Mapping[str, str]) -> Iterator[tuple[str, bool]]:
    """Yield every imported module of one file, and whether it is imported when the file is."""
    modules = {module_of(each) for each in tree}
    module = module_of(path)

    def visit(node: ast.AST, at_import: bool) -> Iterator[tuple[str, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from ((alias.name, at_import) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                source = child.module or ""
                if child.level:
                    package = module if path.endswith("__init__.py") else module.rpartition(".")[0]
                    parts = package.split(".")[: len(package.split(".")) - child.level + 1]
                    source = ".".join([*parts, source] if source else parts)
                for alias in child.names:
                    whole = f"{source}.{alias.name}"
                    yield (whole if whole in modules else source), at_import
            elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                yield from visit(ast.Module(child.orelse, []), at_import)
            else:
                lazy = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                yield from visit(child, at_import and not lazy)

    yield from visit(ast.parse(text), True)


def broken_import_laws(tree: Mapping[str, str]) -> list[str]:
    """Return what *tree* (path to text) does against the import law, one line each."""
    ours = {"rse_pf", "client_sdk", "lambda_pnp", "stacks", "app"}
    broken = []
    for path, text in tree.items():
        room = room_of(module_of(path))
        if room not in MAY_IMPORT:
            broken.append(f"{path}: the law knows no room {room!r}")
            continue
        for name, at_import in imports(path, text, tree):
            top = name.split(".")[0]
            if top in ours:
                other = room_of(name)
                if other != room and other not in MAY_IMPORT[room] | {"rse_pf"}:
                    broken.append(f"{path}: {room} may not import {other}")
            elif top in sys.stdlib_module_names:
                if path.startswith(PURE) and top in IMPURE:
                    broken.append(f"{path}: {top} does not belong into a pure room")
            elif not path.startswith(PACKAGES.get(top, ("nowhere",))):
                broken.append(f"{path}: {top} may not be imported here")
            elif at_import and room in BASE_ROOMS and top not in BASE:
                broken.append(f"{path}: {top} is optional, import it inside a function")
    return broken + [f"import cycle: {' -> '.join(cycle)}" for cycle in cycles(tree)]


def cycles(tree: Mapping[str, str]) -> list[list[str]]:
    """Return cycles among imports that run when the modules are imported."""
    graph = {
        module_of(path): sorted({name for name, at_import in imports(path, text, tree) if at_import})
        for path, text in tree.items()
    }
    found: list[list[str]] = []
    done: set[str] = set()

    def walk(module: str, trail: list[str]) -> None:
        if module in trail:
            found.append([*trail[trail.index(module) :], module])
            return
        if module in done or module not in graph:
            return
        for other in graph[module]:
            walk(other, [*trail, module])
        done.add(module)

    for module in graph:
        walk(module, [])
    return found


def test_the_sources_keep_the_import_law(sources: Mapping[str, str]) -> None:
    assert broken_import_laws(sources) == []


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("client_sdk/robot.py", "from rse_pf.auth import SigningKey"),
        ("client_sdk/robot.py", "import rse_pf.backend.server"),
        ("client_sdk/robot.py", "def f():\n    from rse_pf import scaling"),
        ("client_sdk/robot.py", "import websockets"),
        ("client_sdk/frontend.py", "import cv2"),
        ("client_sdk/offload.py", "def now():\n    import time"),
        ("rse_pf/errors.py", "import rse_pf.settings"),
        ("rse_pf/geometry.py", "from rse_pf.wire import Command"),
        ("rse_pf/wire/codec.py", "from time import monotonic"),
        ("rse_pf/wire/codec.py", "import os.path"),
        ("rse_pf/wire/codec.py", "from ..service import dispatch"),
        ("rse_pf/scaling/policy.py", "import random"),
        ("rse_pf/auth.py", "import jwt"),
        ("rse_pf/pnp/solver.py", "from rse_pf.services import pnp"),
        ("rse_pf/backend/server.py", "from rse_pf.scaling import policy"),
        ("rse_pf/backend/core.py", "import picows"),
        ("rse_pf/local/cloud.py", "from rse_pf.backend import supervisor"),
        ("rse_pf/data_server/app.py", "import boto3"),
        ("rse_pf/experiments/demo.py", "import matplotlib.pyplot"),
        ("rse_pf/experiments/demo.py", "import stacks"),
        ("stacks/monitor.py", "from rse_pf.auth import verify_token"),
        ("lambda_pnp/handler.py", "import requests"),
        ("rse_pf/attic/old.py", "pass"),
    ],
)
def test_the_import_law_catches(sources: Mapping[str, str], path: str, text: str) -> None:
    hollow = dict.fromkeys(sources, "")

    assert broken_import_laws({**hollow, path: text})


def test_the_import_law_catches_a_cycle_inside_a_room() -> None:
    tree = {
        "rse_pf/wire/a.py": "from rse_pf.wire import b",
        "rse_pf/wire/b.py": "import rse_pf.wire.c",
        "rse_pf/wire/c.py": "from rse_pf.wire.a import thing",
    }

    assert broken_import_laws(tree) == [
        "import cycle: rse_pf.wire.a -> rse_pf.wire.b -> rse_pf.wire.c -> rse_pf.wire.a"
    ]


def test_a_lazy_import_and_an_import_for_types_make_no_cycle() -> None:
    tree = {
        "rse_pf/wire/a.py": "def f():\n    from rse_pf.wire import b",
        "rse_pf/wire/b.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import rse_pf.wire.a",
    }

    assert broken_import_laws(tree) == []
