"""An ASGI application on a port of this machine, behind the protocol of the platform's services."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from typing import Any

import uvicorn

from rse_pf.http.connections import bounded_protocol


@contextlib.asynccontextmanager
async def http_service(app: Any, **bounds: Any) -> AsyncIterator[int]:
    """Serve *app* with the *bounds* of `bounded_protocol`; yield the port."""
    listening = socket.create_server(("127.0.0.1", 0), backlog=1024)
    protocol = bounded_protocol(**{"most_idle": 100, **bounds})
    config = uvicorn.Config(
        # The time of uvicorn itself for a waiting connection, which must not count.
        app, http=protocol, ws="none", lifespan="off", log_level="critical", timeout_keep_alive=0,
        server_header=False, date_header=False,
    )  # fmt: skip
    server = uvicorn.Server(config)
    server.install_signal_handlers = lambda: None  # type: ignore[attr-defined]
    with contextlib.closing(listening):
        serving = asyncio.ensure_future(server._serve([listening]))
        while not server.started:
            await asyncio.sleep(0)
        try:
            yield listening.getsockname()[1]
        finally:
            server.should_exit = server.force_exit = True
            await serving
