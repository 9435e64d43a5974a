"""Run the data service: images, keyframes, clouds and maps by HTTP, under /data/.

/data/healthz, /data/readyz and /data/openapi.json need no token.  Ctrl-C or SIGTERM ends the service after
the requests that it has.  Keys that are written after its start are found.

example:
  rse-pf data --keys keys.json --store dir:objects --port 0 --announce data.json
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.aws.storage import open_data_store
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings, setting_rows
from rse_pf.errors import UsageError
from rse_pf.terminal import show_page

__all__ = ["ACTION"]

_ROWS = {row.name: row for row in setting_rows() if row.group == "data"}


def _setting(name: str) -> Any:
    """Return the option that overrides the setting ``data.NAME``, with its help and default."""
    row = _ROWS[name]
    return option(f"--{name}", help=f"{row.doc} (data.{name}, default {row.default})")


@dataclass(frozen=True, kw_only=True)
class DataRequest:
    """The options of rse-pf data: its listener, its store, its keys and its files."""

    host: str | None = _setting("host")
    port: int | None = _setting("port")
    store: str | None = _setting("store")
    keys: Path | None = option(
        "--keys",
        metavar="FILE",
        help="public keys of the tokens, a JWKS; the folder control/ next to it holds roster and deny list",
    )
    audit: Path | None = option(
        "--audit", metavar="DIR", help="folder of the audit log of map changes and refused tokens"
    )
    openapi: bool = option("--openapi", help="print the OpenAPI document and exit")
    announce: Path | None = option(
        "--announce", metavar="FILE", help="write pid and port to FILE when the service is ready"
    )


def run_data(request: DataRequest, settings: PlatformSettings) -> int:
    """Run the data service until SIGINT or SIGTERM, or print its OpenAPI document; return the exit code."""
    if request.openapi:
        from rse_pf.data_server.routes import openapi_page

        show_page(openapi_page())
        return 0
    if request.keys is None:
        raise UsageError("--keys is missing", hint="give a JWKS; rse-pf local writes one as keys.json")
    chosen = settings.replace(
        data={
            name: value
            for name, value in (("host", request.host), ("port", request.port), ("store", request.store))
            if value is not None
        }
    )
    for option_name, file in (("--keys", request.keys), ("--announce", request.announce)):
        if file is not None and not file.absolute().parent.is_dir():
            folder = file.absolute().parent
            raise UsageError(f"{option_name}: there is no folder {folder}", hint="create the folder")
    from rse_pf.data_server.server import KeysFile, serve_data

    store, keys = open_data_store(chosen), KeysFile(request.keys)
    return serve_data(chosen, store, keys=keys, announce=request.announce, audit=request.audit)


ACTION = Action(request=DataRequest, run=run_data)
