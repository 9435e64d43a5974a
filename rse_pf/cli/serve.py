"""Run one backend server: a supervisor, its worker processes, and a control port.

The control port answers /healthz, /readyz, /metrics and /status; with --control-token the first two to
everybody, the rest to who carries it.  SIGTERM drains: robots are moved and
nothing is lost.  Ctrl-C leaves at once.  To run a whole platform, use rse-pf local.

example:
  rse-pf serve --keys keys.json --port 0 --announce server.json
"""

from __future__ import annotations

import argparse
import contextlib
import os
import resource
from pathlib import Path

from rse_pf.auth.control_token import read_control_token
from rse_pf.auth.tokens import KeySet
from rse_pf.auth.trust_store import TrustStore
from rse_pf.config import PlatformSettings, setting_rows
from rse_pf.errors import UsageError

__all__ = ["add_arguments", "run"]

_OPTIONS: dict[str, type] = {
    "host": str, "port": int, "control_host": str, "control_port": int, "workers": int,
    "emulated_cores": float, "log_level": str,
}  # fmt: skip
"""Options that are settings of the same name."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    rows = {row.name: row for row in setting_rows() if row.group == "serving"}
    for name, kind in _OPTIONS.items():
        row = rows[name]
        unit = f" [{row.unit}]" if row.unit else ""
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=kind, dest=name, choices=row.choices or None,
            metavar=None if row.choices else name.rpartition("_")[2].upper(),
            help=f"{row.doc}{unit} (serving.{name}, default {row.default})",
        )  # fmt: skip
    parser.add_argument(
        "--keys", type=Path, metavar="FILE",
        help="public keys of the tokens, a JWKS; roster and deny-list lie beside it in control/",
    )  # fmt: skip
    parser.add_argument(
        "--control-token", type=Path, metavar="FILE",
        help="whoever asks the control port for more than its health must carry what stands there",
    )  # fmt: skip
    parser.add_argument("--server-id", metavar="NAME", help="name of this server (default: server-PID)")
    parser.add_argument(
        "--announce", type=Path, metavar="FILE", help="write pids and ports there when all is ready"
    )
    parser.add_argument(
        "--audit", type=Path, metavar="DIR", help="record there who came in and who was refused"
    )
    parser.add_argument("--store", metavar="PLACE", help="where objects live (data.store)")
    parser.add_argument(
        "--services", type=Path, metavar="DIR", help="run the services installed there (services.folder)"
    )
    parser.add_argument(
        "--accept-weak-isolation", action="store_true",
        help="run them even where this kernel lacks a wall (services.accept_weak_isolation)",
    )  # fmt: skip
    parser.add_argument(
        "--conformance-echo", action="store_true", help="echo raw messages without tokens, loopback only"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Serve until a drain or a signal ends it."""
    overrides = {name: getattr(args, name) for name in _OPTIONS if getattr(args, name) is not None}
    services: dict[str, object] = {}
    if args.services is not None:
        services["folder"] = str(args.services.absolute())
    if args.accept_weak_isolation:
        services["accept_weak_isolation"] = True
    data = {} if args.store is None else {"store": args.store}
    chosen = settings.replace(serving=overrides, services=services, data=data)
    server_id = f"server-{os.getpid()}" if args.server_id is None else args.server_id
    if not 0 < len(server_id) <= 64 or not server_id.isprintable():
        raise UsageError(f"{server_id[:80]!r} is no name for a server", hint="use 1 to 64 printable letters")
    keys = None if args.keys is None else _keys(args.keys)
    token = None if args.control_token is None else read_control_token(args.control_token)
    if args.announce is not None and not args.announce.absolute().parent.is_dir():
        raise UsageError(
            f"there is no folder {args.announce.absolute().parent}",
            hint="make it, or name another --announce",
        )
    _open_many_files()
    from rse_pf.backend.supervisor import serve

    return serve(
        chosen,
        keys=keys,
        trust=None if args.keys is None else TrustStore(args.keys),
        server_id=server_id,
        announce=args.announce,
        conformance_echo=args.conformance_echo,
        settings_digest=settings.digest(),
        audit=args.audit,
        control_token=token,
    )


def _keys(path: Path) -> KeySet:
    try:
        return KeySet.from_json(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text"
        raise UsageError(
            f"cannot read the keys {path}: {reason}", hint="name a JWKS; rse-pf local writes one as keys.json"
        ) from error


def _open_many_files() -> None:
    """Every robot needs a descriptor; take as many as the system allows without asking."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
