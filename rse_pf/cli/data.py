"""Run the data service: images, keyframes, clouds and maps by HTTP, under /data/.

It answers /data/healthz, /data/readyz and /data/openapi.json without a token.  Ctrl-C or SIGTERM ends it
when its requests are answered.  Keys that come later than the service are picked up.

example:
  rse-pf data --keys keys.json --store dir:objects --port 0 --announce data.json
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rse_pf.auth.trust_store import REFRESH_S
from rse_pf.config import PlatformSettings, setting_rows
from rse_pf.errors import UsageError
from rse_pf.object_store import ObjectStore, open_store

__all__ = ["add_arguments", "open_any_store", "run"]

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
        help="public keys of the tokens, a JWKS; roster and deny-list lie beside it in control/",
    )  # fmt: skip
    parser.add_argument(
        "--audit", type=Path, metavar="DIR", help="record there how maps change, and who was refused"
    )
    parser.add_argument(
        "--openapi", action="store_true", help="print the OpenAPI document and do nothing else"
    )
    parser.add_argument(
        "--announce", type=Path, metavar="FILE", help="write pid and port there when all is ready"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Serve until a signal ends it."""
    if args.openapi:
        from rse_pf.data_server.routes import openapi_page

        sys.stdout.write(openapi_page())
        return 0
    if args.keys is None:
        raise UsageError("--keys is missing", hint="name a JWKS; rse-pf local writes one as keys.json")
    chosen = settings.replace(
        data={name: getattr(args, name) for name in _OPTIONS if getattr(args, name) is not None}
    )
    for file in (args.keys, args.announce):
        if file is not None and not file.absolute().parent.is_dir():
            raise UsageError(f"there is no folder {file.absolute().parent}", hint="make it, or name another")
    store = open_any_store(chosen)
    from rse_pf.data_server.server import KeysFile, serve_data

    keys = KeysFile(args.keys, REFRESH_S)
    return serve_data(chosen, store, keys=keys, announce=args.announce, audit=args.audit)


def open_any_store(settings: PlatformSettings) -> ObjectStore:
    """Return the store of ``data.store``, also if it is a bucket; raises UsageError."""

    def bucket(name: str) -> ObjectStore:
        from rse_pf.aws.storage import open_bucket

        return open_bucket(name, settings.cloud.region)

    return open_store(settings.data.store, {"s3": bucket})
