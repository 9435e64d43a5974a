"""Run the rosbridge server: one process that accepts clients and answers health checks of load balancers.

A client sends its token in the WebSocket handshake or, as browsers must, in its first message.  The number of
clients whose token the platform has not accepted yet is limited, and so is the time that they have.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import time
from functools import partial
from http import HTTPStatus
from pathlib import Path
from urllib.parse import urlsplit

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.http11 import Request, Response

from rse_pf.auth.origins import ORIGIN_HINT, AllowedOrigins, carried_token
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import HEALTH_PATH, ROSBRIDGE_PATH
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.extensions.rosbridge.client import Client
from rse_pf.extensions.rosbridge.topics import Topics
from rse_pf.http.unauthenticated import BACKLOG, SilentConnections
from rse_pf.server.gateway.rate_limits import SourceRates
from rse_pf.services.builtin import builtin_services
from rse_pf.storage.files import replace_json
from rse_pf.wire.live_map import LIVE_REQUESTS
from rse_pf.wire.server_session import CLOSE_GOING_AWAY, CLOSE_TOKEN_OVER

__all__ = ["open_rosbridge", "serve_rosbridge"]

# Largest rate of handshakes of one address, after a burst.  For the platform, the handshakes of all clients
# come from the address of this process, and it allows ten times as many, so that one client cannot use up the
# limit of all.
_HANDSHAKES_PER_S = 20.0
# Longest time from the handshake until the platform has accepted a client's token, in seconds.
_TOKEN_TIMEOUT_S = 5.0


class _Clients:
    """Accepts all clients of this process, and enforces the limits on unauthenticated ones."""

    def __init__(self, settings: PlatformSettings, url: str) -> None:
        self._settings, self._url = settings, url
        self._origins = AllowedOrigins(settings.serving.allowed_origins)
        self._topics = Topics()
        live = LIVE_REQUESTS if settings.data.enabled else ()
        self._services = tuple(sorted((*builtin_services(settings).names, *live)))
        serving = settings.serving
        rate = min(_HANDSHAKES_PER_S, serving.max_handshakes_per_source_per_s)
        self._rates = SourceRates(settings.replace(serving={"max_handshakes_per_source_per_s": rate}).serving)
        self._silent: SilentConnections[ServerConnection] = SilentConnections(
            call_later=asyncio.get_running_loop().call_later, seconds=_TOKEN_TIMEOUT_S,
            most=serving.max_unauthenticated, most_per_source=serving.max_unauthenticated_per_source,
        )  # fmt: skip
        self._closing: set[asyncio.Task[None]] = set()

    def answer_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the HTTP response to a health check or to a rejected request; None to open the WebSocket."""
        headers = request.headers
        path = request.path.partition("?")[0]
        if path == HEALTH_PATH:
            return connection.respond(HTTPStatus.OK, "ok\n")
        if path != ROSBRIDGE_PATH:
            return connection.respond(HTTPStatus.NOT_FOUND, f"connect to {ROSBRIDGE_PATH}\n")
        if not self._origins.allows(headers.get("Origin", ""), headers.get("Host", "")):
            text = f"web pages of this origin are not allowed; {ORIGIN_HINT}\n"
            return connection.respond(HTTPStatus.FORBIDDEN, text)
        if self._rates.wait_s(self._source(connection, request), time.monotonic()) > 0:
            return connection.respond(
                HTTPStatus.TOO_MANY_REQUESTS, "too many connections of this address: try again later\n"
            )
        if len(connection.server.connections) > self._settings.serving.max_robots:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many clients: try again later\n")
        return None

    async def serve_client(self, connection: ServerConnection) -> None:
        """Serve a client whose WebSocket is open, until it disconnects."""
        assert connection.request is not None
        headers = connection.request.headers
        offered = ",".join(headers.get_all("Sec-WebSocket-Protocol")).replace(" ", "").split(",")
        client = Client(
            connection, url=self._url, token=carried_token(headers.get("Authorization", ""), offered),
            topics=self._topics, services=self._services, session=self._settings.session,
        )  # fmt: skip
        self._silent.enter(
            connection, partial(self._cut, connection), self._source(connection, connection.request)
        )
        try:
            await client.serve(lambda: self._silent.leave(connection))
        finally:
            self._silent.leave(connection)

    def _source(self, connection: ServerConnection, request: Request) -> str:
        """Return a client's IP address; behind trusted proxies, it is taken from ``X-Forwarded-For``."""
        forwarded = ",".join(request.headers.get_all("X-Forwarded-For"))
        return self._rates.source(str(connection.remote_address[0]), forwarded)

    def _cut(self, connection: ServerConnection) -> None:
        task = asyncio.ensure_future(connection.close(CLOSE_TOKEN_OVER, "no token was accepted in time"))
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)


def serve_rosbridge(
    settings: PlatformSettings, *, url: str, host: str, port: int, announce: Path | None
) -> int:
    """Serve until SIGTERM or SIGINT; return the exit code.

    Args:
        settings: Settings of the platform; the groups serving, session and data are used.
        url: Address of the platform, ``ws://HOST:PORT/ws``.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        announce: File to which pid and port are written as JSON when clients can connect; None for no file.

    Raises:
        ConfigurationError: The address and port cannot be used, for example because another process does.
        UsageError: *url* is not the address of a platform, or *port* is out of range.
    """
    if not 0 <= port < 65536:
        raise UsageError(f"{port} is not a port", hint="name one from 1 to 65535, or 0 for a free one")
    if urlsplit(url).scheme not in ("ws", "wss") or not urlsplit(url).hostname:
        raise UsageError(f"{url[:80]!r} is not the address of a platform", hint="write ws://HOST:PORT/ws")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise ConfigurationError(
            f"cannot listen on {host}:{port}: {error.strerror}", hint="choose another --port"
        ) from error
    asyncio.run(_serve_until_signal(settings, url, listening, announce))
    return 0


async def open_rosbridge(settings: PlatformSettings, url: str, listening: socket.socket) -> Server:
    """Start to accept clients on the socket *listening*, for the platform at *url*; return the server."""
    session = settings.session
    clients = _Clients(settings, url)
    # asyncio sets TCP_NODELAY only for sockets that name their protocol.  Without it, a ping that follows a
    # message waits for the delayed acknowledgement of the message.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    server: Server = await serve(
        clients.serve_client, sock=listening, process_request=clients.answer_request, compression=None,
        max_size=session.max_message_bytes, open_timeout=session.hello_timeout_s,
        ping_interval=session.ping_interval_s, ping_timeout=session.ping_timeout_s,
        close_timeout=session.stall_timeout_s, server_header=None,
    )  # fmt: skip
    return server


async def _serve_until_signal(
    settings: PlatformSettings, url: str, listening: socket.socket, announce: Path | None
) -> None:
    over = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, over.set)
    # Unauthenticated clients must not fill the log with failed handshakes.
    logging.getLogger("websockets.server").addFilter(lambda record: record.msg != "opening handshake failed")
    server = await open_rosbridge(settings, url, listening)
    if announce is not None:
        replace_json(announce, {"pid": os.getpid(), "port": listening.getsockname()[1]})
    await over.wait()
    server.close(code=CLOSE_GOING_AWAY, reason="leaving")
    await server.wait_closed()
