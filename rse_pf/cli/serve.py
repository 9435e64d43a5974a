"""Run one backend server: the PnP service and its neighbours behind a WebSocket.

example:
  rse-pf serve --port 8765 --keys jwks.json
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rse_pf.errors import UsageError
from rse_pf.settings import PlatformSettings

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--host", help="address for robots (setting serving.host)")
    parser.add_argument("--port", type=int, help="port for robots; 0 takes a free one (serving.port)")
    parser.add_argument("--control-port", type=int, help="port of /readyz, /metrics (serving.control_port)")
    parser.add_argument("--workers", type=int, help="worker processes; 0: one per core (serving.workers)")
    parser.add_argument("--size", type=float, help="emulated size in CPU s per s; 0 is off (serving.size)")
    parser.add_argument("--log-level", help="debug, info, warning or error (serving.log_level)")
    parser.add_argument("--keys", type=Path, metavar="FILE", help="public keys that sign tokens, as a JWKS")
    parser.add_argument("--server-id", default="server", help="name in every answer and log line")
    parser.add_argument("--announce", type=Path, metavar="FILE", help="write pids and ports there when ready")
    parser.add_argument(
        "--conformance-echo", action="store_true", help="echo raw messages, loopback only: for test suites"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Serve until a signal or a drain ends it."""
    from rse_pf.auth import KeySet
    from rse_pf.backend import serve

    given: dict[str, Any] = {
        name: getattr(args, name)
        for name in ("host", "port", "control_port", "workers", "size", "log_level")
        if getattr(args, name) is not None
    }
    keys = None
    if args.keys is not None:
        try:
            keys = KeySet.from_json(args.keys.read_text(encoding="utf-8"))
        except OSError as error:
            raise UsageError(
                f"cannot read {args.keys}: {error.strerror}", hint="name a JWKS file with --keys"
            ) from error
    return serve(
        settings.replace(serving=given),
        keys=keys,
        server_id=args.server_id,
        announce=args.announce,
        conformance_echo=args.conformance_echo,
    )
