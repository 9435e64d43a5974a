"""The first code of a child process: ``python -m rse_pf.processes SOCKET PLAN``.

It imports nothing beside the standard library before the child has its priority and its limits.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from typing import Any

from rse_pf.processes.linux import be_killed_first, die_with_parent, limit_memory, set_process_name

__all__ = ["main"]

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Of a terminal or a service manager, to all processes; the server, which they are for, ends its own."""


def main(arguments: list[str]) -> None:
    """Apply the plan and call its function.

    Args:
        arguments: The number of the socket to the parent, and a `ChildPlan` as JSON with its ``parent``.
    """
    plan: dict[str, Any] = json.loads(arguments[1])
    if plan["parent"] and not die_with_parent(plan["parent"]):
        return
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    if plan["is_killed_first"]:
        be_killed_first()
    run = _imported(plan["target"], plan["import_nice"])
    set_process_name(plan["name"])  # who sees the name, sees a child that can begin
    if plan["memory_bytes"] is not None:
        limit_memory(plan["memory_bytes"])
    run(socket.socket(fileno=int(arguments[0])))


def _imported(target: str, nice: int) -> Callable[[socket.socket], None]:
    """Return the function of the plan, whose module is imported with a niceness that ends with the import."""
    module, _, name = target.partition(":")
    if nice:
        importing = threading.Thread(target=_import_at, args=(module, nice))
        importing.start()
        importing.join()
    function: Callable[[socket.socket], None] = getattr(importlib.import_module(module), name)
    return function


def _import_at(module: str, nice: int) -> None:
    # Linux has a priority for each thread: this one ends, and the others keep theirs.
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + nice)
    importlib.import_module(module)


if __name__ == "__main__":
    main(sys.argv[1:])
