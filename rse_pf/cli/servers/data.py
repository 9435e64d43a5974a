"""Run the data service: images, keyframes, clouds and maps by HTTP, under /data/.

/data/healthz, /data/readyz and /data/openapi.json need no token.  Ctrl-C or SIGTERM ends the service after
the requests that it has.  Keys that are written after its start are found.

example:
  rse-pf data --keys keys.json --store dir:objects --port 0 --announce data.json
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings, setting_rows
from rse_pf.errors import UsageError
from rse_pf.terminal import show_page

__all__ = ["add_arguments", "run"]

# Options that are settings of the same name.
_OPTIONS: dict[str, type] = {"host": str, "port": int, "store": str}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    rows = {row.name: row for row in setting_rows() if row.group == "data"}
    for name, kind in _OPTIONS.items():
        parser.add_argument(
            f"--{name}", type=kind, help=f"{rows[name].doc} (data.{name}, default {rows[name].default})"
        )
    parser.add_argument(
        "--keys", type=Path, metavar="FILE",
        help="public keys of the tokens, a JWKS; roster and deny list are in control/ beside it",
    )  # fmt: skip
    parser.add_argument(
        "--audit",
        type=Path,
        metavar="DIR",
        help="folder of the audit log of map changes and refused tokens",
    )
    parser.add_argument("--openapi", action="store_true", help="print the OpenAPI document and exit")
    parser.add_argument(
        "--announce", type=Path, metavar="FILE", help="file that gets pid and port when the service is ready"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Serve until a signal ends the process."""
    if args.openapi:
        from rse_pf.data_server.routes import openapi_page

        show_page(openapi_page())
        return 0
    if args.keys is None:
        raise UsageError("--keys is missing", hint="give a JWKS; rse-pf local writes one as keys.json")
    chosen = settings.replace(
        data={name: getattr(args, name) for name in _OPTIONS if getattr(args, name) is not None}
    )
    for file in (args.keys, args.announce):
        if file is not None and not file.absolute().parent.is_dir():
            raise UsageError(f"there is no folder {file.absolute().parent}", hint="create the folder")
    from rse_pf.data_server.server import KeysFile, serve_data

    store, keys = open_data_store(chosen), KeysFile(args.keys)
    return serve_data(chosen, store, keys=keys, announce=args.announce, audit=args.audit)
