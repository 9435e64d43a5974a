"""A warm standby: it has imported what `rse-pf serve` needs, and becomes a server when it gets its arguments.

Started by the local platform as ``python -m rse_pf.cli.servers.standby``.  It imports in a thread of low
priority, because servers work at the same time, and prints a line when it is warm.  One JSON line on its
standard input holds the arguments and the log of the server; from then on it works at full priority.  It
exits when that input ends without a line.
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
"""In the order of their imports, so that the thread can stop between any two of them."""
_NICENESS = 3
"""Of the thread that imports `_MODULES`: with one busy process on each core, it gets a third of a core."""


def main() -> int:
    """Import, wait for the arguments of a server, and run it; return its exit code."""
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
    """Import until all is imported or the order has come.  Linux keeps a niceness for each thread."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
    for name in _MODULES:
        if ordered.is_set():
            return
        importlib.import_module(name)
    importlib.import_module("rse_pf.server.supervisor").warm_up()
    show("imported everything that a server needs, and waits for its start")


if __name__ == "__main__":
    sys.exit(main())
