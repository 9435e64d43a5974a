"""Run the server of the page: one process that listens on loopback and writes its port to a file."""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import signal
import socket
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

from rse_pf.auth.control_token import read_control_token
from rse_pf.errors import ConfigurationError, MissingExtra
from rse_pf.extensions.fleet_page.app import FleetApp, PageAccess, PageActions
from rse_pf.extensions.fleet_page.hub import MAX_PAGES, Hub
from rse_pf.extensions.fleet_page.page_sessions import PageSessions
from rse_pf.extensions.fleet_page.static_files import page_files
from rse_pf.http.connections import bounded_protocol
from rse_pf.http.unauthenticated import BACKLOG
from rse_pf.local.state import control_token_file
from rse_pf.storage.files import replace_json

__all__ = ["ANNOUNCEMENT", "listen", "page_url", "serve_page"]

ANNOUNCEMENT = "fleet_page.json"
"""Name of the file with pid and port of the page, in the folder of the platform's state."""
# Address at which the page listens.
_LOOPBACK = "127.0.0.1"
# Largest number of connections that have sent no request yet, and the same of idle ones after a request.
_MAX_SILENT = 2 * MAX_PAGES
# Largest number of connections of the page's server, of any kind.
_MAX_CONNECTIONS = 4 * MAX_PAGES + 2 * _MAX_SILENT
# Longest wait for open requests when the server stops, in seconds.
_STOP_TIMEOUT_S = 1


def page_url(port: int, key: str) -> str:
    """Return the address of the page with *key* after ``#``, a part that browsers do not send to servers."""
    return f"http://{_LOOPBACK}:{port}/#key={key}"


def listen(port: int) -> socket.socket:
    """Return a listening socket on loopback at *port*, or at a free port if *port* is 0 or taken.

    Raises:
        ConfigurationError: No port is free.
    """
    for candidate in (port, 0):
        with contextlib.suppress(OSError):
            return socket.create_server((_LOOPBACK, candidate), backlog=BACKLOG)
    raise ConfigurationError("no port on loopback is free", hint="close other programs")


def serve_page(
    hub: Hub,
    actions: PageActions,
    *,
    listening: socket.socket,
    works: Callable[[], list[Coroutine[Any, Any, None]]],
    platform: Path | None,
    ready: Callable[[str], None],
) -> int:
    """Serve the page until SIGTERM or SIGINT; return the exit code.

    Args:
        hub: The messages of the stream.
        actions: The operations and documents that browsers request.
        listening: The listening socket on loopback.
        works: Returns the coroutines that feed the hub; they run while the page is served.
        platform: Folder of a local platform's state.  Who knows its control token may request keys, and pid
            and port are in a file of the folder while the page is served.  None for a deployment on AWS,
            which has neither.
        ready: Called with the page's address, which contains the first key.

    Raises:
        MissingExtra: uvicorn is not installed.
    """
    try:
        import uvicorn
    except ImportError as error:
        raise MissingExtra("uvicorn", "backend") from error
    port = int(listening.getsockname()[1])
    sessions = PageSessions(secret=lambda: secrets.token_urlsafe(24))
    fallback = secrets.token_hex(32)
    announce = None if platform is None else platform / ANNOUNCEMENT

    def admin_token() -> str:
        return fallback if platform is None else read_control_token(control_token_file(platform))

    access = PageAccess(sessions=sessions, admin_token=admin_token)
    app = FleetApp(hub, access, page_files(), actions)
    config = uvicorn.Config(
        app, http=bounded_protocol(most=_MAX_SILENT, most_idle=_MAX_SILENT), ws="none", lifespan="off",
        access_log=False, log_level="critical",
        limit_concurrency=_MAX_CONNECTIONS, server_header=False, date_header=False, proxy_headers=False,
        timeout_graceful_shutdown=_STOP_TIMEOUT_S, h11_max_incomplete_event_size=16384,
    )  # fmt: skip
    for number in (signal.SIGTERM, signal.SIGINT):
        # uvicorn handles the signals while it serves, and raises them again after it has stopped: without
        # effect.
        signal.signal(number, lambda number, frame: None)

    async def run() -> None:
        server = uvicorn.Server(config)
        tasks = [asyncio.ensure_future(work) for work in works()]
        serving = asyncio.ensure_future(server.serve(sockets=[listening]))
        try:
            while not (server.started or serving.done()):
                await asyncio.sleep(0.005)
            if announce is not None:
                replace_json(announce, {"pid": os.getpid(), "port": port})
            ready(page_url(port, sessions.new_key("view", now_s=time.monotonic())))
            await serving
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if announce is not None:
                announce.unlink(missing_ok=True)

    asyncio.run(run())
    return 0
