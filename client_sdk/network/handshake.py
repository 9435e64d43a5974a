"""Open one WebSocket to one address with the robot's token: proxy, TCP, TLS, HTTP upgrade.

`client_sdk.network.dial_errors` turns each failure into a typed error.  This module and
`client_sdk.network.connection` are the only ones that know the WebSocket library.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as websocket_connect
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from client_sdk.concurrency.user_callbacks import UserCallbacks
from client_sdk.network.bearer_token import strip_token
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.dial_errors import (
    CHECK_ADDRESS,
    DialError,
    hide_password,
    http_status_error,
    no_answer_error,
    tcp_error,
    untrusted_certificate_error,
)
from client_sdk.network.http_proxy import (
    find_proxy,
    open_tunnel,
    port_of,
)
from client_sdk.network.tcp import TcpDialler
from rse_pf.config import SessionSettings
from rse_pf.errors import ConnectError, Unauthorized, UnsupportedProtocol, UsageError
from rse_pf.wire import SUBPROTOCOLS

__all__ = ["Dialler", "Token", "websocket_options"]

Token = str | Callable[[], Awaitable[str]] | None
"""A robot's token, or an async function that returns a fresh one for each connection and each renewal."""

TCP_TIMEOUT_S = 1.0
"""Longest attempt to open a TCP connection, in seconds, even if ``connect_timeout_s`` is longer.  Linux
repeats an unanswered attempt only after 1, 3 and 7 s; a new attempt reaches a server sooner when the network
is back."""
MAX_FIRST_BYTES = 4096
"""Once this many bytes of the peer are held, no further ones are kept.  They explain an answer that is not
HTTP/1.1, and its head and page title are in the first bytes."""


def websocket_options(settings: SessionSettings, timings: ConnectTimings) -> dict[str, Any]:
    """Return the options with which the library websockets opens every WebSocket of the SDK.

    Compression and pings of the library are off: the codec compresses, and RSE-PF's own pings measure delays.
    """
    return {
        "compression": None,
        "max_size": settings.max_message_bytes,
        "ping_interval": None,
        "open_timeout": timings.connect_timeout_s,
        "close_timeout": settings.stall_timeout_s,
        "proxy": None,
    }


class _NoRedirectConnect(websocket_connect):
    """Connect like the library, but follow no redirect: it could lead the token to any address."""

    def process_redirect(self, exc: Exception) -> Exception:
        """Treat a redirect as a failure, like every other status that is not 101."""
        return exc


class _FirstBytesConnection(ClientConnection):
    """Keep the first bytes that the peer sends: they tell what a peer is that is no WebSocket server."""

    def __init__(self, first_bytes: bytearray, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._first_bytes = first_bytes

    def data_received(self, data: bytes) -> None:
        """Copy *data* while fewer than `MAX_FIRST_BYTES` are held, and pass all of it on."""
        if len(self._first_bytes) < MAX_FIRST_BYTES:
            self._first_bytes += data[:MAX_FIRST_BYTES]
        super().data_received(data)


class Dialler:
    """Open WebSockets as one robot."""

    def __init__(
        self,
        token: Token,
        *,
        codec: str,
        settings: SessionSettings,
        timings: ConnectTimings,
        callbacks: UserCallbacks,
    ) -> None:
        """Keep what is needed to open WebSockets as one robot; nothing is opened yet.

        Args:
            token: The robot's token, an async function that returns one, or None.
            codec: Name of the codec, which selects the WebSocket sub-protocol.
            settings: Limits of messages.
            timings: Timeouts of an attempt.
            callbacks: Calls *token* if it is a function.
        """
        self.token = token
        self.ssl_context: ssl.SSLContext | None = None
        """What the robot trusts at ``wss:`` addresses; None means the authorities of the machine."""
        self._subprotocol = SUBPROTOCOLS[codec]
        self._settings = settings
        self._timings = timings
        self._callbacks = callbacks
        self._tcp = TcpDialler()

    async def open(self, url: str, on_answered: Callable[[], None]) -> tuple[ClientConnection, str | None]:
        """Return a WebSocket to *url*, and the text of the token in its handshake (None without a token).

        If the token is refused and comes from a function, a second one is requested and tried once, unless
        the refusal says that no token would be accepted now.

        Args:
            url: WebSocket address of the servers.
            on_answered: Called for each TCP connection that a machine at the address, or the proxy in front
                of it, accepted or refused.

        Raises:
            DialError: There is no WebSocket; the error names the cause.
        """
        token = await self.read_token()
        try:
            return await self._shake_hands(url, token, on_answered), token
        except DialError as failure:
            is_refused = isinstance(failure.error, Unauthorized) and not failure.refuses_any_token
            if not callable(self.token) or not is_refused:
                raise
        token = await self.read_token()
        return await self._shake_hands(url, token, on_answered), token

    async def read_token(self) -> str | None:
        """Return the text of a token without white space around it, None if the robot has none.

        Raises:
            DialError: The function of the program failed, or what it returned cannot be a token.
        """
        if not callable(self.token):
            token = self.token
        else:
            try:
                token = await self._callbacks.fetch_token(self.token)
            except ConnectError as error:
                raise DialError(error) from error
        if token is None:
            return None
        try:
            return strip_token(token)
        except Unauthorized as error:
            raise DialError(error, is_refusal=True) from None

    async def _connect_tcp(self, url: str, on_answered: Callable[[], None]) -> socket.socket:
        """Return a TCP connection to the host of *url*, perhaps through a proxy of the environment."""
        parts, timeout_s = urlsplit(url), self._timings.connect_timeout_s
        host, port = parts.hostname or "", port_of(parts)
        try:
            proxy = find_proxy(parts.scheme, host, port)
        except UsageError as error:
            raise DialError(error, is_wrong_address=True) from None
        try:
            if proxy is None:
                connection = await self._tcp.connect(host, port, min(TCP_TIMEOUT_S, timeout_s))
            else:
                connection = await asyncio.to_thread(open_tunnel, proxy, parts, timeout_s)
        except OSError as error:
            failure = tcp_error(hide_password(url), error)
            if not failure.is_unanswered:
                on_answered()
            raise failure from error
        except DialError as failure:
            if not failure.is_unanswered:
                on_answered()
            raise
        on_answered()
        connection.setblocking(False)
        return connection

    async def _shake_hands(
        self, url: str, token: str | None, on_answered: Callable[[], None]
    ) -> ClientConnection:
        # 1. Open the TCP connection, perhaps through a proxy.
        address, options = hide_password(url), websocket_options(self._settings, self._timings)
        options["sock"] = await self._connect_tcp(url, on_answered)
        if self.ssl_context is not None and url.startswith("wss:"):
            options["ssl"] = self.ssl_context
        # 2. Do the TLS handshake and the HTTP upgrade; explain a failure by what the peer showed.
        first_bytes = bytearray()
        try:
            websocket = await _NoRedirectConnect(
                url,
                subprotocols=[Subprotocol(self._subprotocol)],
                additional_headers={} if token is None else {"Authorization": f"Bearer {token}"},
                create_connection=partial(_FirstBytesConnection, first_bytes),  # type: ignore[arg-type]
                **options,
            )
        except InvalidStatus as error:
            response = error.response
            headers = dict(response.headers.raw_items())
            body = bytes(response.body or b"")
            raise http_status_error(address, response.status_code, headers, body) from error
        except ssl.SSLCertVerificationError as error:
            is_enrolled = self.ssl_context is not None
            raise untrusted_certificate_error(address, error, is_enrolled=is_enrolled) from error
        except (OSError, asyncio.TimeoutError, WebSocketException, EOFError) as error:
            raise no_answer_error(
                address, error, first_bytes=bytes(first_bytes), within_s=options["open_timeout"]
            ) from error
        # 3. Check that the server chose our sub-protocol.
        if websocket.subprotocol != self._subprotocol:
            websocket.transport.abort()
            unsupported = UnsupportedProtocol(
                f"{address} does not speak {self._subprotocol}", hint=CHECK_ADDRESS
            )
            raise DialError(unsupported, is_wrong_address=True)
        return websocket
