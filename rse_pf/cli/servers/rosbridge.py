"""Run the rosbridge server: programs that speak rosbridge v2 use a platform, with their own tokens.

/healthz needs no token.  Ctrl-C or SIGTERM closes the clients and ends the server.

example:
  rse-pf rosbridge --url ws://127.0.0.1:8700/ws --port 9090
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ROBOTS_PATH, ROSBRIDGE_PORT
from rse_pf.errors import UsageError

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--url", metavar="URL",
        help="address of the platform (default: the backend server of this machine, at serving.port)",
    )  # fmt: skip
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument(
        "--port", type=int, default=ROSBRIDGE_PORT, metavar="P",
        help="port to listen on; 0 takes a free one (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--announce", type=Path, metavar="FILE", help="file that gets pid and port when clients can connect"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Serve until a signal ends the process."""
    if args.announce is not None and not args.announce.absolute().parent.is_dir():
        raise UsageError(f"there is no folder {args.announce.absolute().parent}", hint="create the folder")
    from rse_pf.extensions.rosbridge.server import serve_rosbridge

    url = args.url or f"ws://127.0.0.1:{settings.serving.port}{ROBOTS_PATH}"
    return serve_rosbridge(settings, url=url, host=args.host, port=args.port, announce=args.announce)
