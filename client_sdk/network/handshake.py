"""Open one WebSocket to one address, with the token of the robot; `dialling` explains failures.

This module and `client_sdk.network.connection` are the only ones that know the WebSocket library.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any
from urllib.parse import SplitResult, urlsplit

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as websocket_connect
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from client_sdk.concurrency.user_callbacks import Callbacks
from client_sdk.network.bearer_token import strip_token
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.dial_errors import (
    CHECK_ADDRESS,
    DialError,
    dial_error_of,
    hide_password,
    unconnected_error,
    unreachable,
    untrusted_error,
)
from client_sdk.network.http_proxy import Proxy, TunnelRefused, check_tunnel, is_complete_head, proxy_of
from client_sdk.network.peer_diagnosis import explain_proxy
from client_sdk.network.peer_probe import Probed, port_of, probe
from client_sdk.network.tcp import TcpDialler
from rse_pf.config import SessionSettings
from rse_pf.errors import ConnectError, Unauthorized, UnsupportedProtocol, UsageError
from rse_pf.wire import SUBPROTOCOLS

__all__ = ["Dialler", "Token", "websocket_options"]

Token = str | Callable[[], Awaitable[str]] | None
"""A robot's token, or an async callable that returns a fresh one for each connect and each renewal."""


_ANSWER_S = 1.0
"""How long a TCP connection may take before another attempt begins."""
_FIRST_BYTES = 4096
"""Of an answer that is no HTTP/1.1: its head, and the begin of a page."""


def websocket_options(settings: SessionSettings, timings: ConnectTimings) -> dict[str, Any]:
    """Return the options of every WebSocket: no compression, no pings of the library, our size limit."""
    return {
        "compression": None,
        "max_size": settings.max_message_bytes,
        "ping_interval": None,
        "open_timeout": timings.connect_timeout_s,
        "close_timeout": settings.stall_timeout_s,
        "proxy": None,
    }


class _StraightConnect(websocket_connect):
    """The library's, which would follow a redirect, token and all, to whatever address it names."""

    def process_redirect(self, exc: Exception) -> Exception:
        """Take a redirect as the refusal that any other status is."""
        return exc


class _ObservedConnection(ClientConnection):
    """Keep the peer's first bytes in *seen*: they name a peer that is no WebSocket server."""

    def __init__(self, seen: bytearray, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._seen = seen

    def data_received(self, data: bytes) -> None:
        """Note the begin of the handshake's answer."""
        if len(self._seen) < _FIRST_BYTES:
            self._seen += data[:_FIRST_BYTES]
        super().data_received(data)


class Dialler:
    """Opens WebSockets as one robot; *codec* names the sub-protocol."""

    def __init__(
        self,
        token: Token,
        *,
        codec: str,
        settings: SessionSettings,
        timings: ConnectTimings,
        callbacks: Callbacks,
    ) -> None:
        self.token = token
        self.ssl_context: ssl.SSLContext | None = None
        self._subprotocol = SUBPROTOCOLS[codec]
        self._settings = settings
        self._timings = timings
        self._callbacks = callbacks
        self._tcp = TcpDialler()
        self._opened: set[str] = set()

    async def open(self, url: str, on_answered: Callable[[], None]) -> tuple[ClientConnection, str | None]:
        """Return a WebSocket to *url* and the token that it was opened with; raises DialError.

        A token that is refused is asked for once more, if it comes from a callable and another one may help.

        Args:
            url: Of the servers.
            on_answered: Called for each attempt that reached something: it accepted or refused a connection.
        """
        token = await self.read_token()
        try:
            return await self._handshake(url, token, on_answered), token
        except DialError as failed:
            if not callable(self.token) or not isinstance(failed.error, Unauthorized) or failed.refuses_any:
                raise
        token = await self.read_token()
        return await self._handshake(url, token, on_answered), token

    async def read_token(self) -> str | None:
        """Return the token without white space around it, which files and shells add; raises DialError."""
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

    async def _connect(self, url: str, on_answered: Callable[[], None]) -> socket.socket:
        """Return a TCP connection to the host of *url*, through the proxy of the environment, if any."""
        parts, within_s = urlsplit(url), min(_ANSWER_S, self._timings.connect_timeout_s)
        host, port = parts.hostname or "", port_of(parts)
        try:
            proxy = proxy_of(parts.scheme, host, port)
        except UsageError as error:
            raise DialError(error, is_wrong_address=True) from None
        try:
            if proxy is None:
                made = await self._tcp.connect(host, port, within_s)
            else:
                made = await self._tcp.connect(proxy.host, proxy.port, within_s)
        except OSError as error:
            failed = unconnected_error(hide_password(url), error)
            if proxy is not None:
                failed.error = _proxy_error(url, proxy)
            if not failed.is_unanswered:
                on_answered()
            raise failed from error
        on_answered()
        if proxy is not None:
            try:
                await self._open_tunnel(made, proxy, parts, url)
            except BaseException:
                made.close()
                raise
        return made

    async def _open_tunnel(self, made: socket.socket, proxy: Proxy, parts: SplitResult, url: str) -> None:
        loop = asyncio.get_running_loop()

        async def ask() -> bytes:
            await loop.sock_sendall(made, proxy.connect_request(parts.hostname or "", port_of(parts)))
            head = b""
            while not is_complete_head(head) and (byte := await loop.sock_recv(made, 1)):
                head += byte
            return head

        try:
            head = await asyncio.wait_for(ask(), self._timings.connect_timeout_s)
            check_tunnel(hide_password(url), proxy, head)
        except (OSError, asyncio.TimeoutError) as error:
            raise DialError(_proxy_error(url, proxy)) from error
        except TunnelRefused as refused:
            raise DialError(refused.error, is_wrong_address=refused.is_lasting) from None

    async def _handshake(
        self, url: str, token: str | None, on_answered: Callable[[], None]
    ) -> ClientConnection:
        address, options = hide_password(url), websocket_options(self._settings, self._timings)
        options["sock"] = await self._connect(url, on_answered)
        if self.ssl_context is not None and url.startswith("wss:"):
            options["ssl"] = self.ssl_context
        seen = bytearray()
        try:
            websocket = await _StraightConnect(
                url,
                subprotocols=[Subprotocol(self._subprotocol)],
                additional_headers={} if token is None else {"Authorization": f"Bearer {token}"},
                create_connection=partial(_ObservedConnection, seen),  # type: ignore[arg-type]
                **options,
            )
        except InvalidStatus as error:
            response = error.response
            headers = dict(response.headers.raw_items())
            raise dial_error_of(
                address, response.status_code, headers, bytes(response.body or b"")
            ) from error
        except ssl.SSLCertVerificationError as error:
            issuer, is_enrolled = (await self._probe(url)).issuer, self.ssl_context is not None
            raise untrusted_error(address, error, issuer=issuer, is_enrolled=is_enrolled) from error
        except (OSError, asyncio.TimeoutError, WebSocketException, EOFError) as error:
            # An address where a WebSocket was once open has the right scheme and program.
            is_asked = not seen and url not in self._opened
            probed = await self._probe(url) if is_asked else None
            raise unreachable(
                address, error, first_bytes=bytes(seen), probed=probed, within_s=options["open_timeout"]
            ) from error
        self._opened.add(url)
        if websocket.subprotocol != self._subprotocol:
            websocket.transport.abort()
            unsupported = UnsupportedProtocol(
                f"{address} does not speak {self._subprotocol}", hint=CHECK_ADDRESS
            )
            raise DialError(unsupported, is_wrong_address=True)
        return websocket

    async def _probe(self, url: str) -> Probed:
        within_s = min(_ANSWER_S, self._timings.connect_timeout_s)
        return await asyncio.to_thread(probe, urlsplit(url), within_s)


def _proxy_error(url: str, proxy: Proxy) -> ConnectError:
    return explain_proxy(hide_password(url), proxy.shown, proxy.variable, None, has_credentials=False)
