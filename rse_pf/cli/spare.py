"""A server that is not one yet: it has imported what `rse-pf serve` needs, and waits to be told which it is.

Started by the local platform as ``python -m rse_pf.cli.spare``; one JSON line on its standard input names the
arguments and the log.  Promises to listen nowhere and to hold no key before it is told, and to go when nobody
is left who could tell it.
"""

from __future__ import annotations

import importlib
import json
import os
import sys

from rse_pf.backend import warm_up
from rse_pf.cli import main as front

__all__ = ["main"]


def main() -> int:
    """Wait for the order, then be that server."""
    importlib.import_module("rse_pf.cli.serve")
    warm_up()
    line = sys.stdin.buffer.readline()
    if not line.endswith(b"\n"):
        return 0
    order = json.loads(line)
    log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o666)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for ours, standard in ((nothing, 0), (log, 1), (log, 2)):
        os.dup2(ours, standard)
    os.close(nothing)
    os.close(log)
    return front.main(order["arguments"])


if __name__ == "__main__":
    sys.exit(main())
