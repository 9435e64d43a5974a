"""rse-pf cloud logs: what servers logged, also those that are gone, and what a failed boot wrote."""

from __future__ import annotations

import argparse
from datetime import datetime, timezone

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.terminal import counted, show

__all__ = ["add_arguments", "run"]

_MAX_LINES = 100_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the server and how much of it is shown."""
    parser.add_argument(
        "server", nargs="?", metavar="SERVER", help="instance id; without it the servers with journals"
    )
    parser.add_argument("--lines", type=int, default=200, metavar="N", help="newest lines (default: 200)")
    parser.add_argument(
        "--console", action="store_true", help="what the machine wrote to its console, such as a failed boot"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Print lines, or the servers that have some; return 1 if there are none."""
    from rse_pf.aws.account import open_account
    from rse_pf.aws.fleet.server_logs import console_of, last_lines, list_logged_servers, open_journals

    if not 1 <= args.lines <= _MAX_LINES:
        raise UsageError(f"--lines {args.lines} is not within 1..{_MAX_LINES}", hint="name how many lines")
    if args.console and args.server is None:
        raise UsageError("--console needs a server", hint="name one: rse-pf cloud logs lists them")
    account = open_account(settings.cloud.region)
    if args.console:
        lines = console_of(account, args.server)
    else:
        store = open_journals(account, ResourceNames(settings.cloud.name))
        servers = list_logged_servers(store)
        if args.server is None:
            for server in servers:
                newest = datetime.fromtimestamp(server.newest_s, timezone.utc)
                show(f"{server.name}  {newest:%Y-%m-%d %H:%M:%S} UTC  {counted(len(server.pieces), 'piece')}")
            if not servers:
                show("no server has sent its journals; they come every minute")
            return 0 if servers else 1
        matching = [server for server in servers if server.name == args.server]
        # A boot that failed early shipped nothing, and its console is all that there is.
        lines = last_lines(store, matching[0], args.lines) if matching else console_of(account, args.server)
    if not lines:
        show(f"{args.server} has sent no journals, and AWS has no console of it")
        return 1
    show(*lines[-args.lines :])
    return 0
