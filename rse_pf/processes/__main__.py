"""The start of a child process: ``python -m rse_pf.processes SOCKET PLAN``.

This module imports only the standard library and `rse_pf.processes.linux`, so that all other imports of the
child have the niceness of its plan.
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
"""Signals that a child ignores: a terminal or a service manager sends them to all processes, but the parent
ends its children itself."""


def main(arguments: list[str]) -> None:
    """Apply the plan of this child process, and call its function with the socket to the parent.

    Returns at once if the parent has exited already.

    Args:
        arguments: The number of the descriptor of the socket, and a `ChildPlan` as JSON with the additional
            member ``parent``: the pid of the parent, 0 if the child may outlive it.
    """
    plan: dict[str, Any] = json.loads(arguments[1])
    if plan["parent"] and not die_with_parent(plan["parent"]):
        return
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    if plan["is_killed_first"]:
        be_killed_first()
    run = _imported(plan["target"], plan["import_nice"])
    set_process_name(plan["name"])  # after the import, so that the name shows that the child can begin
    if plan["memory_bytes"] is not None:
        limit_memory(plan["memory_bytes"])
    run(socket.socket(fileno=int(arguments[0])))


def _imported(target: str, nice: int) -> Callable[[socket.socket], None]:
    """Return the function *target* (``module:function``); its module is imported with *nice* more niceness.

    The niceness of the process does not change.
    """
    module, _, name = target.partition(":")
    if nice:
        importing = threading.Thread(target=_import_at, args=(module, nice))
        importing.start()
        importing.join()
    function: Callable[[socket.socket], None] = getattr(importlib.import_module(module), name)
    return function


def _import_at(module: str, nice: int) -> None:
    # Linux has a niceness for each thread.  This thread raises its own, and ends after the import.
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + nice)
    importlib.import_module(module)


if __name__ == "__main__":
    main(sys.argv[1:])
