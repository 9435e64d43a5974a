"""Run a warm standby: a process that imports what `rse-pf serve` needs, and then waits to become a server.

The local platform starts it as ``python -m rse_pf.cli.servers.standby``.  It imports in a thread of low
priority, because servers work at the same time, and prints a line when all is imported.  One JSON line on its
standard input, with the arguments and the log of the server, makes it a server of full priority.  It exits if
its standard input is closed before that.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading

from rse_pf.terminal import show

__all__ = ["main"]

_MODULES = (
    "numpy", "jwt", "cryptography.hazmat.primitives.asymmetric.ed25519", "uvloop", "picows",
    "prometheus_client", "rse_pf.cli.main", "rse_pf.cli.servers.serve", "rse_pf.server.supervisor",
)  # fmt: skip
"""Modules that a server needs, in the order of their imports; the thread can stop between any two of them."""
# Niceness of the thread that imports `_MODULES`: with one busy process on each core, it gets a third of a
# core.
_NICENESS = 3


def main() -> int:
    """Import in the background, wait for the arguments of a server, and run it; return its exit code.

    Returns 0 if standard input is closed without arguments.
    """
    ordered = threading.Event()
    importer = threading.Thread(target=_import_slowly, args=(ordered,), daemon=True)
    importer.start()
    line = sys.stdin.buffer.readline()
    if not line.endswith(b"\n"):
        return 0
    ordered.set()
    importer.join()
    order = json.loads(line)
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for ours, standard in ((nothing, 0), (log, 1), (log, 2)):
        os.dup2(ours, standard)
    os.close(nothing)
    os.close(log)
    code: int = importlib.import_module("rse_pf.cli.main").main(order["arguments"])
    return code


def _import_slowly(ordered: threading.Event) -> None:
    """Import `_MODULES` at low priority, and stop before the next one once *ordered* is set.

    Linux keeps a niceness for each thread, so the rest of the process is not slowed down.
    """
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
    for name in _MODULES:
        if ordered.is_set():
            return
        importlib.import_module(name)
    importlib.import_module("rse_pf.server.supervisor").warm_up()
    show("imported everything that a server needs, and waits for its start")


if __name__ == "__main__":
    sys.exit(main())
