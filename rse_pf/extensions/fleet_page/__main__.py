"""Run the fleet page of a platform of this machine: ``python -m rse_pf.extensions.fleet_page FOLDER``.

The process prints one line of JSON with the page's address, and serves until its parent exits.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rse_pf.errors import RsePfError
from rse_pf.extensions.fleet_page.local_page import serve_local_page
from rse_pf.processes.linux import die_with_parent, set_process_name
from rse_pf.terminal import show_error

__all__ = ["main"]


def main() -> int:
    """Parse the arguments, serve the page until a signal or the parent's exit, and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m rse_pf.extensions.fleet_page")
    parser.add_argument("folder", type=Path, help="folder of the platform's state")
    parser.add_argument("--port", type=int, default=0, help="port on loopback; 0 takes a free one")
    parser.add_argument("--parent", type=int, default=None, help="process to end with")
    given = parser.parse_args()
    if given.parent is not None and not die_with_parent(given.parent):
        return 0
    set_process_name("rse-pf page")
    try:
        return serve_local_page(given.folder, port=given.port)
    except RsePfError as error:
        show_error(error)
        return 1


if __name__ == "__main__":
    sys.exit(main())
