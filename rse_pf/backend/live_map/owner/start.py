"""Begin the process of an owner: import what it needs, at a low priority if nobody waits for it yet.

A process that is started for later leaves the processors to those that serve robots now.
"""

from __future__ import annotations

import os
import sys
import threading

__all__ = ["main"]


def main(arguments: list[str]) -> None:
    """Import `rse_pf.backend.live_map.owner.process` and run it.

    Args:
        arguments: The number of its socket, and the nice value at which to import.
    """
    importing = threading.Thread(target=_import_at, args=(int(arguments[1]),))
    importing.start()
    importing.join()
    from rse_pf.backend.live_map.owner.process import main as serve

    serve(arguments[:1])


def _import_at(nice: int) -> None:
    # Linux has a priority for each thread: this one ends, and the others keep theirs.
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + nice)
    import rse_pf.backend.live_map.owner.process  # noqa: F401  imported for its time only


if __name__ == "__main__":
    main(sys.argv[1:])
