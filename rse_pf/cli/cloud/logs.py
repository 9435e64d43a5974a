"""rse-pf cloud logs: what servers logged, also those that are gone, and what a failed boot wrote."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone

from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.terminal import counted, show

__all__ = ["ACTION"]

# Largest value of --lines.
_MAX_LINES = 100_000


@dataclass(frozen=True, kw_only=True)
class LogsRequest:
    """The options of rse-pf cloud logs: the server whose log is shown, and how many lines of it."""

    server: str | None = option(
        nargs="?", metavar="SERVER", help="instance id; without it the servers with journals are listed"
    )
    lines: int = option("--lines", default=200, metavar="N", help="newest lines (default: 200)")
    console: bool = option("--console", help="show the console of the machine, for example of a failed boot")


def show_logs(request: LogsRequest, settings: PlatformSettings) -> int:
    """Print the newest lines of a server's log or console; without a server, the servers that have logs.

    Returns 1 if there are none, else 0.
    """
    from rse_pf.aws.account import open_account
    from rse_pf.aws.fleet.server_logs import console_of, last_lines, list_logged_servers, open_journals

    if not 1 <= request.lines <= _MAX_LINES:
        raise UsageError(f"--lines {request.lines} is not within 1..{_MAX_LINES}", hint="name how many lines")
    if request.console and request.server is None:
        raise UsageError("--console needs a server", hint="name one: rse-pf cloud logs lists them")
    account = open_account(settings.cloud.region)
    if request.console and request.server is not None:
        lines = console_of(account, request.server)
    else:
        store = open_journals(account, ResourceNames(settings.cloud.name))
        servers = list_logged_servers(store)
        if request.server is None:
            for server in servers:
                newest = datetime.fromtimestamp(server.newest_s, timezone.utc)
                show(f"{server.name}  {newest:%Y-%m-%d %H:%M:%S} UTC  {counted(len(server.pieces), 'piece')}")
            if not servers:
                show("no server has sent its journals; they come every minute")
            return 0 if servers else 1
        matching = [server for server in servers if server.name == request.server]
        # A server whose boot failed early has sent no journal: its console is shown in place of it.
        lines = (
            last_lines(store, matching[0], request.lines) if matching else console_of(account, request.server)
        )
    if not lines:
        show(f"{request.server} has sent no journals, and AWS has no console of it")
        return 1
    show(*lines[-request.lines :])
    return 0


ACTION = Action(
    help="show what a server logged, also one that was removed, and the console of a failed boot",
    request=LogsRequest,
    run=show_logs,
)
