"""Run the rosbridge server: programs that speak rosbridge v2 use a platform, with their own tokens.

/healthz needs no token.  Ctrl-C or SIGTERM closes the clients and ends the server.

example:
  rse-pf rosbridge --url ws://127.0.0.1:8700/ws --port 9090
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ROBOTS_PATH, ROSBRIDGE_PORT
from rse_pf.errors import UsageError

__all__ = ["ACTION"]


@dataclass(frozen=True, kw_only=True)
class RosbridgeRequest:
    """Options of ``rse-pf rosbridge``: the platform, and the address to which rosbridge clients connect."""

    url: str | None = option(
        "--url",
        metavar="URL",
        help="address of the platform (default: the backend server of this machine, at serving.port)",
    )
    host: str = option("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    port: int = option(
        "--port",
        default=ROSBRIDGE_PORT,
        metavar="P",
        help="port to listen on; 0 takes a free one (default: %(default)s)",
    )
    announce: Path | None = option(
        "--announce", metavar="FILE", help="write pid and port to FILE when clients can connect"
    )


def run_rosbridge(request: RosbridgeRequest, settings: PlatformSettings) -> int:
    """Check the options, and serve until a signal ends the process; return the exit code."""
    if request.announce is not None and not request.announce.absolute().parent.is_dir():
        folder = request.announce.absolute().parent
        raise UsageError(f"--announce: there is no folder {folder}", hint="create the folder")
    from rse_pf.extensions.rosbridge.server import serve_rosbridge

    url = request.url or f"ws://127.0.0.1:{settings.serving.port}{ROBOTS_PATH}"
    return serve_rosbridge(settings, url=url, host=request.host, port=request.port, announce=request.announce)


ACTION = Action(request=RosbridgeRequest, run=run_rosbridge)
