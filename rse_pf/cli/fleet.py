"""Print a new address of the fleet page, which shows a running platform in a browser on this machine.

rse-pf local starts the page.  An address has a key that works once, within an hour, in one browser.
--operate makes a key with which the page may kill, pause, drain, move and roll servers; it can also be typed
into a page that is open.

examples:
  rse-pf fleet
  rse-pf fleet --operate
"""

from __future__ import annotations

import argparse
import os

from rse_pf.cli.extras import require
from rse_pf.cli.local import DEFAULT_NAME
from rse_pf.config import PlatformSettings
from rse_pf.terminal import show, show_json

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--name", default=DEFAULT_NAME, help=f"name of the platform (default: {DEFAULT_NAME})"
    )
    parser.add_argument("--operate", action="store_true", help="the page may operate the platform")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Print the address."""
    require("fleet")
    from rse_pf.cli.local_platform.page import new_address
    from rse_pf.local.state import state_folder

    url = new_address(state_folder(args.name, os.environ), "operate" if args.operate else "view")
    if args.json:
        show_json({"url": url})
    else:
        show(f"fleet page  {url}", "the key works once, within an hour")
    return 0
