"""Begin the process of an owner: import what it needs, calmly if nobody waits for it yet.

A process that is started for later leaves the processors to those that serve robots now.
"""

from __future__ import annotations

import os
import sys
import threading

__all__ = ["CALMLY", "main"]

CALMLY = "calmly"
_NICE = 10


def main(arguments: list[str]) -> None:
    """Import and run `rse_pf.backend.live_map.owner.process` with the first of *arguments*."""
    if CALMLY in arguments[1:]:
        importing = threading.Thread(target=_import_calmly)
        importing.start()
        importing.join()
    from rse_pf.backend.live_map.owner.process import main as serve

    serve(arguments[:1])


def _import_calmly() -> None:
    # Linux has a priority for each thread: this one ends, and the others keep theirs.
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
    import rse_pf.backend.live_map.owner.map_kind
    import rse_pf.backend.live_map.owner.process  # noqa: F401


if __name__ == "__main__":
    main(sys.argv[1:])
