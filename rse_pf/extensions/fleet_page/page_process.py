"""Start the process of a local platform's fleet page, and request new addresses from it."""

from __future__ import annotations

import contextlib
import http.client
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from rse_pf.auth.control_token import bearer, read_control_token
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.extensions.fleet_page.server import ANNOUNCEMENT, page_url
from rse_pf.local.side_process import run_beside_platform
from rse_pf.local.state import control_token_file

__all__ = ["new_address", "run_page"]

# File in the platform's folder with the output of the page's process.
_LOG = "fleet_page.log"
# Time limit of a request for a new key, in seconds.
_TIMEOUT_S = 5.0


@contextlib.asynccontextmanager
async def run_page(folder: Path, port: int, on_address: Callable[[str], None]) -> AsyncIterator[None]:
    """Run the page's process for the platform in *folder* inside the block.

    *on_address* is called with the page's address once the page serves.
    """
    async with run_beside_platform("rse_pf.extensions.fleet_page", folder, port, folder / _LOG, on_address):
        yield


def new_address(folder: Path, role: str) -> str:
    """Return a new address of the running page with a one-time key for *role*, ``view`` or ``operate``.

    Raises:
        UsageError: No page is running for this platform.
        CommandFailed: The page does not answer, or rejects the request.
    """
    try:
        port = int(json.loads((folder / ANNOUNCEMENT).read_text(encoding="utf-8"))["port"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"no fleet page runs for platform {folder.name!r}",
            hint=f"start it: rse-pf local --name {folder.name}",
        ) from error
    token = read_control_token(control_token_file(folder))
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=_TIMEOUT_S)
    try:
        connection.request(
            "POST", "/keys", json.dumps({"role": role}), headers={"Authorization": bearer(token)}
        )
        reply = connection.getresponse()
        answer: dict[str, Any] = json.loads(reply.read())
        if reply.status != 200:
            raise CommandFailed(f"the fleet page answers {reply.status}", hint=str(answer.get("hint", "")))
        return page_url(port, str(answer["key"]))
    except (OSError, http.client.HTTPException, ValueError, KeyError) as error:
        raise CommandFailed(
            "the fleet page does not answer", hint=f"look at {folder / _LOG}, or start the platform again"
        ) from error
    finally:
        connection.close()
