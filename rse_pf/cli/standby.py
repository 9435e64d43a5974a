"""A server that is not one yet: it has imported what `rse-pf serve` needs, and waits to be told which it is.

Started by the local platform as ``python -m rse_pf.cli.standby``; it says a word when all is imported, and
one JSON line on its standard input names the arguments and the log.  It imports slowly, a quarter of a core
at most, because servers work beside it.  Promises to listen nowhere and to hold no key before it is told,
not to dawdle once it is, and to go when nobody is left who could tell it.
"""

from __future__ import annotations

import importlib
import importlib.abc
import json
import os
import select
import sys
import time

__all__ = ["main"]

_MAX_S = 0.01
"""Of work without a rest, where one module does not take longer."""
_REST = 3.0
"""Rest so many times as long as was worked."""


class _Rests(importlib.abc.MetaPathFinder):
    """Finds no module; whoever looks for one is held back a little, until the order is there."""

    def __init__(self) -> None:
        self._worked_s = time.process_time()
        self._is_wanted = False

    def find_spec(self, fullname: str, path: object, target: object = None) -> None:
        worked_s = time.process_time() - self._worked_s
        if worked_s > _MAX_S and not self._is_wanted:
            self._is_wanted = bool(select.select([0], [], [], _REST * worked_s)[0])
            self._worked_s = time.process_time()


def main() -> int:
    """Wait for the order, then be that server."""
    rests = _Rests()
    sys.meta_path.insert(0, rests)
    front = importlib.import_module("rse_pf.cli.main")
    importlib.import_module("rse_pf.cli.serve")
    importlib.import_module("rse_pf.backend.supervisor").warm_up()
    sys.meta_path.remove(rests)
    print("warm", flush=True)
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
    code: int = front.main(order["arguments"])
    return code


if __name__ == "__main__":
    sys.exit(main())
