"""Print a new address of the fleet page, which shows a running platform in a browser on this machine.

rse-pf local starts the page.  An address has a key that works once, within an hour, in one browser.
--operate makes a key with which the page may kill, pause, drain, move and roll servers; it can also be typed
into a page that is open.  --cloud runs the page of the deployment on AWS here, with your credentials, until
Ctrl-C: it only reads, and opens no port there.

examples:
  rse-pf fleet
  rse-pf fleet --operate
  rse-pf fleet --cloud
  rse-pf fleet --cloud --port 8702
"""

from __future__ import annotations

import os
from dataclasses import dataclass

from rse_pf.command_line.extras import require
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import show, show_json

__all__ = ["ACTION"]

# Name of the platform whose page is shown by default.
_DEFAULT_NAME = "default"

# Largest TCP port.
_MAX_PORT = 65535


@dataclass(frozen=True, kw_only=True)
class FleetRequest:
    """Options of ``rse-pf fleet``: the platform whose page is shown, and whether the page may operate it."""

    name: str = option(
        "--name", default=_DEFAULT_NAME, help=f"name of the platform (default: {_DEFAULT_NAME})"
    )
    operate: bool = option("--operate", help="the page may operate the platform")
    json: bool = option("--json", help="print JSON")
    cloud: bool = option("--cloud", help="show the deployment on AWS in cloud.region")
    port: int | None = option(
        "--port", metavar="PORT", help="with --cloud: port on loopback (default: a free one)"
    )


def show_page_address(request: FleetRequest, settings: PlatformSettings) -> int:
    """Print a new address of the running page; with --cloud, serve a page until a signal.

    Return the exit code.
    """
    if request.cloud:
        return _run_cloud(request, settings)
    if request.port is not None:
        raise UsageError("--port is for --cloud", hint="the port of a local page: local.page_port")
    require("fleet")
    from rse_pf.extensions.fleet_page.page_process import new_address
    from rse_pf.local.state import state_folder

    url = new_address(state_folder(request.name, os.environ), "operate" if request.operate else "view")
    if request.json:
        show_json({"url": url})
    else:
        show(f"fleet page  {url}", "the key works once, within an hour")
    return 0


def _run_cloud(request: FleetRequest, settings: PlatformSettings) -> int:
    require("fleet --cloud")
    from rse_pf.aws.account import open_account
    from rse_pf.extensions.fleet_page.cloud_page import serve_cloud_page

    if request.operate:
        raise UsageError("--operate is for a local platform", hint="see docs/operations.md")
    if request.port is not None and not 0 <= request.port <= _MAX_PORT:
        raise UsageError(f"--port {request.port} is not within 0..{_MAX_PORT}", hint="0 takes a free one")

    def ready(url: str) -> None:
        if request.json:
            show_json({"url": url})
        else:
            show(f"fleet page  {url}", "the key works once, within an hour; Ctrl-C ends the page")

    return serve_cloud_page(
        open_account(settings.cloud.region), settings, port=request.port or 0, ready=ready
    )


ACTION = Action(request=FleetRequest, run=show_page_address)
