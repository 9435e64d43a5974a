"""Run one backend server: a supervisor, its worker processes, and a control port.

The control port answers /healthz, /readyz, /metrics and /status.  With --control-token, only the first two
are answered without that token.  SIGTERM drains the server: its robots move to other servers, and no command
is lost.  Ctrl-C ends it at once.  To run a whole platform, use rse-pf local.

example:
  rse-pf serve --keys keys.json --port 0 --announce server.json
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from rse_pf.auth.control_token import read_control_token
from rse_pf.auth.trust_store import TrustStore
from rse_pf.config import PlatformSettings, setting_rows
from rse_pf.config.placement import ServerPlacement
from rse_pf.errors import UsageError
from rse_pf.extensions.recording.writer import with_recordings

if TYPE_CHECKING:
    from rse_pf.server.worker_context import ServerRecorder

__all__ = ["add_arguments", "run"]

_PLACEMENT: dict[str, type] = {
    "host": str, "port": int, "control_host": str, "control_port": int, "workers": int, "store": str,
    "live_host": str,
}  # fmt: skip
"""Options that override the placement in the settings file."""
_ROWS = {"store": ("data", "store"), "live_host": ("live", "host")}
"""Options that are no settings of the group serving."""
_SETTINGS: dict[str, type] = {"emulated_cores": float, "log_level": str}
"""Options that override settings of the same name."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    rows = {(row.group, row.name): row for row in setting_rows()}
    for name, kind in {**_PLACEMENT, **_SETTINGS}.items():
        row = rows[_ROWS.get(name, ("serving", name))]
        unit = f" [{row.unit}]" if row.unit else ""
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=kind, choices=row.choices or None,
            metavar=None if row.choices else name.rpartition("_")[2].upper(),
            help=f"{row.doc}{unit} ({row.group}.{row.name}, default {row.default})",
        )  # fmt: skip
    parser.add_argument(
        "--keys", type=Path, metavar="FILE",
        help="public keys of the tokens, a JWKS; roster and deny list are beside it in control/",
    )  # fmt: skip
    parser.add_argument(
        "--control-token", type=Path, metavar="FILE",
        help="require the token in FILE on the control port, but for its two health pages",
    )  # fmt: skip
    parser.add_argument("--server-id", metavar="NAME", help="name of this server (default: server-PID)")
    parser.add_argument(
        "--announce", type=Path, metavar="FILE", help="write pids and ports to FILE when all is ready"
    )
    parser.add_argument("--audit", type=Path, metavar="DIR", help="record accepted and refused robots in DIR")
    parser.add_argument(
        "--record", type=Path, metavar="DIR",
        help="record what robots and servers say in DIR, for rse-pf replay (recording.folder)",
    )  # fmt: skip
    parser.add_argument(
        "--record-key", type=Path, metavar="FILE",
        help="key of the pseudonyms in recordings, the same for all servers (default: one of its own)",
    )  # fmt: skip
    parser.add_argument(
        "--services", type=Path, metavar="DIR", help="run the services installed in DIR (services.folder)"
    )
    parser.add_argument(
        "--follow-services", type=Path, metavar="LINK",
        help="run the services in the folder that LINK leads to, and load them anew when the control port is "
        "told to (services.follow); those that cannot be loaded are left out",
    )  # fmt: skip
    parser.add_argument(
        "--accept-weak-isolation", action="store_true",
        help="run them even if this kernel lacks a kind of isolation (services.accept_weak_isolation)",
    )  # fmt: skip
    parser.add_argument(
        "--conformance-echo", action="store_true", help="echo raw messages without tokens, loopback only"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Serve until a drain or a signal ends it."""
    services: dict[str, object] = {}
    if args.services is not None and args.follow_services is not None:
        raise UsageError("--services and --follow-services exclude each other", hint="leave one of them out")
    if args.services is not None:
        services["folder"] = str(args.services.absolute())
    if args.follow_services is not None:
        services.update(folder=str(args.follow_services.absolute()), follow=True)
    if args.accept_weak_isolation:
        services["accept_weak_isolation"] = True
    chosen = settings.replace(serving=_given(args, _SETTINGS), services=services)
    if args.record is not None:
        chosen = with_recordings(chosen, args.record)
    placement = ServerPlacement.read(args.settings, chosen, **_given(args, _PLACEMENT))
    server_id = f"server-{os.getpid()}" if args.server_id is None else args.server_id
    if not 0 < len(server_id) <= 64 or not server_id.isprintable():
        raise UsageError(f"{server_id[:80]!r} is no name for a server", hint="use 1 to 64 printable letters")
    token = None if args.control_token is None else read_control_token(args.control_token)
    if args.announce is not None and not args.announce.absolute().parent.is_dir():
        raise UsageError(
            f"there is no folder {args.announce.absolute().parent}",
            hint="make it, or name another --announce",
        )
    trust = None if args.keys is None else _trust(args.keys)
    from rse_pf.server.supervisor import serve

    return serve(
        chosen,
        placement=placement,
        trust=trust,
        server_id=server_id,
        announce=args.announce,
        conformance_echo=args.conformance_echo,
        audit=args.audit,
        control_token=token,
        recorder=_recorder(chosen, server_id, args.record_key),
    )


def _recorder(settings: PlatformSettings, server_id: str, key: Path | None) -> ServerRecorder | None:
    if not settings.recording.folder:
        return None
    from rse_pf.extensions.recording.server_recorder import FileServerRecorder

    return FileServerRecorder(settings, server_id, key)


def _given(args: argparse.Namespace, options: dict[str, type]) -> dict[str, object]:
    return {name: getattr(args, name) for name in options if getattr(args, name) is not None}


def _trust(keys: Path) -> TrustStore:
    try:
        keys.open("rb").close()
    except OSError as error:
        raise UsageError(
            f"cannot read the keys {keys}: {error.strerror}",
            hint="name a JWKS; rse-pf local writes one as keys.json",
        ) from error
    return TrustStore(keys)
