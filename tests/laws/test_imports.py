"""The import law: who may import whom, and which packages are let in where.

Packages stand in one line, `ORDER`: each may import only what stands before it, so that no import points up
and no circle can form.  Imports for types and imports inside functions count like all others.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping

import pytest

ORDER = (
    "rse_pf", "errors", "event_loop", "terminal", "linux", "one_thread",
    "files", "disk_reserve", "geometry", "native",
    "native_buffers", "native_matcher", "native_front_end", "native_tracker", "native_stereo", "images",
    "token_bucket", "config",
    "silent_connections", "control_http", "http_head", "http_connections", "page_cache", "budget", "wire",
    "ipc", "child",
    "scaling",
    "object_store", "lease", "identity", "crash_record", "maps", "accounts", "auth", "enrolment", "audit",
    "service",
    "pnp", "slam", "services.mapping", "live_map", "services.custom", "services",
    "recording", "recording.replay",
    "aws", "aws.storage", "aws.canary", "aws.fleet", "aws.money", "aws.lifecycle",
    "batch",
    "backend", "backend.scheduling", "backend.sandbox", "backend.jobs", "backend.live_map", "backend.compute",
    "backend.rosbridge",
    "backend.gateway",
    "backend.supervisor",
    "data_server",
    "local", "local.balancer", "local.servers", "local.control", "local.faults",
    "client_sdk.monocular",
    "client_sdk", "client_sdk.bags", "client_sdk.transfer", "client_sdk.datasets", "client_sdk.cameras",
    "client_sdk.simulator",
    "client_sdk.facade",
    "ros_bridge",
    "fleet_page",
    "lambda_pnp",
    "stacks", "stacks.boot", "app",
    "experiments", "experiments.results", "experiments.plots", "experiments.load", "experiments.demo",
    "experiments.compare",
    "experiments.paper", "cli",
)  # fmt: skip
"""All packages and root modules, lowest first; ``rse_pf.`` is left out.

``client_sdk.facade`` is ``client_sdk/__init__.py``, which lists what robots use from all of the SDK.
"""

LEAVES = {"backend", "data_server", "local", "client_sdk", "lambda_pnp", "stacks"}
"""They never import each other; `experiments` and `cli` alone stand above them."""
_BELOW = {each.partition(".")[0] for each in ORDER[: ORDER.index("backend")]}

ONLY: dict[str, set[str]] = {
    "backend": _BELOW - {"scaling"},
    "data_server": _BELOW - {"scaling"},
    "lambda_pnp": _BELOW - {"scaling", "aws"},
    "local": {
        "config",
        "control_http",
        "scaling",
        "errors",
        "auth",
        "object_store",
        "audit",
        "linux",
        "files",
        "disk_reserve",
        "terminal",
        "recording",
        "silent_connections",
    },
    "client_sdk": {
        "config",
        "enrolment",
        "errors",
        "files",
        "geometry",
        "images",
        "native",
        "native_front_end",
        "native_matcher",
        "slam",
        "live_map",
        "token_bucket",
        "maps",
        "wire",
        "service",
        "services",
        "pnp",
        "recording",
    },
    "fleet_page": _BELOW | {"local", "client_sdk"},
    "ros_bridge": {"errors", "geometry", "slam", "terminal", "client_sdk"},
    "stacks": {"config", "scaling", "errors"},
    "app": {"config", "errors", "stacks"},
    "experiments": _BELOW | LEAVES - {"stacks"},
    "cli": _BELOW | LEAVES - {"stacks"} | {"experiments", "fleet_page"},
}
"""Where the order alone would allow too much, by top package."""

PACKAGES: dict[str, tuple[str, ...]] = {
    "numpy": ("rse_pf/", "client_sdk/", "lambda_pnp/", "ros_bridge/"),
    "msgspec": ("rse_pf/", "client_sdk/", "lambda_pnp/"),
    "websockets": (
        "client_sdk/network/connection.py",
        "client_sdk/network/handshake.py",
        "client_sdk/network/region_sockets.py",
    ),
    "cv2": (
        "rse_pf/images.py",
        "rse_pf/pnp/engines.py",
        "client_sdk/datasets/recordings.py",
        "client_sdk/monocular/",
    ),
    "pyrealsense2": ("client_sdk/cameras/realsense.py",),
    "h5py": ("client_sdk/datasets/recordings.py", "client_sdk/datasets/nyu.py"),
    "poselib": ("rse_pf/pnp/engines.py",),
    "picows": ("rse_pf/backend/gateway/websocket.py",),
    "aiofastnet": ("rse_pf/backend/",),
    "uvloop": ("rse_pf/event_loop.py",),
    "prometheus_client": (
        "rse_pf/backend/",
        "rse_pf/data_server/",
        "rse_pf/local/control/federation.py",
    ),
    "uvicorn": ("rse_pf/http_connections.py", "rse_pf/data_server/server.py", "rse_pf/fleet_page/server.py"),
    "jwt": ("rse_pf/auth/tokens.py",),
    "cryptography": ("rse_pf/auth/tokens.py", "rse_pf/auth/certificates.py"),
    "boto3": ("rse_pf/aws/",),
    "distributed": ("rse_pf/batch/",),
    "botocore": ("rse_pf/aws/",),
    "aws_cdk": ("stacks/", "app.py"),
    "constructs": ("stacks/", "app.py"),
    "jsii": ("stacks/",),
    "cdk_nag": ("stacks/", "app.py"),
    "matplotlib": ("rse_pf/experiments/plots/figures.py",),
    "PIL": (
        "rse_pf/experiments/plots/map_image.py",
        "rse_pf/recording/replay/",
        "rse_pf/recording/robot_recorder.py",
    ),
    "mcap": ("rse_pf/recording/",),
    "rosbags": ("client_sdk/bags/",),
    "apsw": ("client_sdk/bags/",),
    "viser": ("rse_pf/experiments/plots/map_viewer.py",),
    "rich": ("rse_pf/cli/", "rse_pf/experiments/"),
    "lupa": ("rse_pf/services/",),
    "packaging": ("rse_pf/services/custom/dependencies.py",),
    "gtsam": ("rse_pf/slam/optimise.py",),
    "small_gicp": ("rse_pf/slam/icp.py",),
    "faiss": ("rse_pf/slam/descriptors.py",),
    "envoy": ("rse_pf/local/",),
}
BASE = {"numpy", "msgspec", "websockets"}
BASE_ROOMS = ONLY["client_sdk"] | {"client_sdk", "rse_pf", "auth", "scaling", "object_store"}
"""What a robot may import with nothing but the base packages installed."""

PURE = (
    "rse_pf/wire/",
    "rse_pf/slam/",
    "rse_pf/scaling/",
    "rse_pf/auth/tokens.py",
    "rse_pf/audit/chain.py",
    "client_sdk/offloading/burst_rules.py",
    "client_sdk/offloading/offload.py",
)
IMPURE = {
    "time", "datetime", "sched", "socket", "socketserver", "select", "selectors", "ssl", "threading",
    "_thread", "concurrent", "multiprocessing", "subprocess", "random", "secrets", "uuid", "os",
    "signal", "asyncio",
}  # fmt: skip


def package_of(module: str) -> str:
    """Return the entry of `ORDER` that a dotted module name belongs to, "" if there is none."""
    name = module.removeprefix("rse_pf.")
    if module == "client_sdk":
        return "client_sdk.facade"
    while name and name not in ORDER:
        name = name.rpartition(".")[0]
    return name


def module_of(path: str) -> str:
    """Return the dotted name of a source file."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imports(path: str, text: str, modules: set[str]) -> Iterator[tuple[str, bool]]:
    """Yield every imported module of one file, and whether it is imported when the file is."""
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
            else:
                types = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
                lazy = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                yield from visit(child, at_import and not lazy and not types)

    yield from visit(ast.parse(text), True)


def broken_import_laws(tree: Mapping[str, str]) -> list[str]:
    """Return what *tree* (path to text) does against the import law, one line each."""
    modules = {module_of(each) for each in tree}
    graph = {path: list(imports(path, text, modules)) for path, text in tree.items()}
    broken = []
    for path, found in graph.items():
        package = package_of(module_of(path))
        if not package or (package == "rse_pf" and path != "rse_pf/__init__.py"):
            broken.append(f"{path}: the law knows no package of this name")
            continue
        for name, at_import in found:
            broken += [f"{path}: {what}" for what in _wrong(path, package, name, at_import)]
    return broken + [f"import cycle: {' -> '.join(cycle)}" for cycle in cycles(graph)]


def _wrong(path: str, package: str, name: str, at_import: bool) -> Iterator[str]:
    top, room = name.split(".")[0], package.partition(".")[0]
    if top in {"rse_pf", "client_sdk", "lambda_pnp", "ros_bridge", "stacks", "app"}:
        other = package_of(name)
        if other == "client_sdk.facade" and room != "client_sdk":
            other = "client_sdk"
        allowed = ONLY.get(room, _BELOW) | {room, "rse_pf"}
        if ORDER.index(other) > ORDER.index(package):
            yield f"{package} may not import {other}, which stands above it"
        elif other.partition(".")[0] not in allowed:
            yield f"{package} may not import {other}"
    elif top in sys.stdlib_module_names:
        if path.startswith(PURE) and top in IMPURE:
            yield f"{top} does not belong into a pure package"
    elif not path.startswith(PACKAGES.get(top, ("nowhere",))):
        yield f"{top} may not be imported here"
    elif at_import and room in BASE_ROOMS and top not in BASE:
        yield f"{top} is optional, import it inside a function"


def cycles(graph: Mapping[str, list[tuple[str, bool]]]) -> list[list[str]]:
    """Return cycles among modules, whenever their imports run."""
    edges = {module_of(path): sorted({name for name, _ in found}) for path, found in graph.items()}
    edges.pop("client_sdk", None)  # the facade: nothing inside of the SDK may import it
    found: list[list[str]] = []
    done: set[str] = set()

    def walk(module: str, trail: list[str]) -> None:
        if module in trail:
            found.append([*trail[trail.index(module) :], module])
            return
        if module in done or module not in edges:
            return
        for other in edges[module]:
            walk(other, [*trail, module])
        done.add(module)

    for module in edges:
        walk(module, [])
    return found


def test_the_sources_keep_the_import_law(sources: Mapping[str, str]) -> None:
    assert broken_import_laws(sources) == []


@pytest.mark.parametrize(
    ("path", "text"),
    [
        ("client_sdk/robot.py", "from rse_pf.auth.tokens import SigningKey"),
        ("client_sdk/robot.py", "import rse_pf.backend.gateway.websocket"),
        ("client_sdk/robot.py", "def f():\n    from rse_pf import scaling"),
        ("client_sdk/robot.py", "import websockets"),
        ("client_sdk/frontend.py", "import cv2"),
        ("client_sdk/offloading/offload.py", "def now():\n    import time"),
        ("rse_pf/errors.py", "import rse_pf.config.settings"),
        ("rse_pf/geometry.py", "from rse_pf.wire import Command"),
        ("rse_pf/wire/codec.py", "from time import monotonic"),
        ("rse_pf/wire/codec.py", "import os.path"),
        ("rse_pf/wire/codec.py", "from ..service import dispatch"),
        ("rse_pf/scaling/policy.py", "import random"),
        ("rse_pf/auth/tokens.py", "import jwt"),
        ("rse_pf/pnp/solver.py", "from rse_pf.services import pnp"),
        ("rse_pf/backend/gateway/websocket.py", "from rse_pf.scaling import policy"),
        ("rse_pf/backend/gateway/dispatcher.py", "import picows"),
        ("rse_pf/local/control/platform.py", "from rse_pf.backend import supervisor"),
        ("rse_pf/data_server/app.py", "import boto3"),
        ("rse_pf/experiments/demo/run.py", "import matplotlib.pyplot"),
        ("rse_pf/experiments/demo/run.py", "import stacks"),
        ("stacks/monitor.py", "from rse_pf.auth.tokens import verify_token"),
        ("lambda_pnp/handler.py", "import requests"),
        ("rse_pf/attic/old.py", "pass"),
        ("rse_pf/attic.py", "pass"),
        ("rse_pf/backend/scheduling/scheduler.py", "from rse_pf.backend.gateway import frames"),
        (
            "rse_pf/backend/gateway/token_watch.py",
            "if TYPE_CHECKING:\n    from rse_pf.backend.supervisor.worker import WorkerPlan",
        ),
        ("rse_pf/wire/codec.py", "def f():\n    from rse_pf.service import dispatch"),
        ("client_sdk/robot.py", "from client_sdk import connect"),
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


@pytest.mark.parametrize(
    "back",
    [
        "def f():\n    import rse_pf.wire.a",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import rse_pf.wire.a",
    ],
)
def test_a_lazy_import_and_an_import_for_types_count_as_well(back: str) -> None:
    tree = {"rse_pf/wire/a.py": "from rse_pf.wire import b", "rse_pf/wire/b.py": back}

    assert broken_import_laws(tree) == ["import cycle: rse_pf.wire.a -> rse_pf.wire.b -> rse_pf.wire.a"]
