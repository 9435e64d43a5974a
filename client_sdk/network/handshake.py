"""Open one WebSocket to one address, with the token of the robot; `dialling` explains failures.

This module and `client_sdk.network.connection` are the only ones that know the WebSocket library.
"""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Awaitable, Callable
from typing import Any

from websockets.asyncio.client import ClientConnection
from websockets.asyncio.client import connect as websocket_connect
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from client_sdk.network.dialling import (
    CHECK_ADDRESS,
    DialError,
    dial_error_of,
    shown_address,
    unreachable,
    untrusted,
)
from client_sdk.token_text import checked_token
from rse_pf.config import SessionSettings
from rse_pf.errors import ConnectError, RsePfError, Unauthorized, UnsupportedProtocol
from rse_pf.wire import SUBPROTOCOLS

__all__ = ["Dialler", "Token", "websocket_options"]

Token = str | Callable[[], Awaitable[str]] | None
"""A robot's token, or an async callable that returns a fresh one for each connect and each renewal."""


def websocket_options(settings: SessionSettings) -> dict[str, Any]:
    """Return the options of every WebSocket: no compression, no pings of the library, our size limit."""
    return {
        "compression": None,
        "max_size": settings.max_message_bytes,
        "ping_interval": None,
        "open_timeout": settings.connect_timeout_s,
        "close_timeout": settings.stall_timeout_s,
        "proxy": None,
    }


class Dialler:
    """Opens WebSockets as one robot; *codec* names the sub-protocol."""

    def __init__(self, token: Token, *, codec: str, settings: SessionSettings) -> None:
        self.token = token
        self.ssl_context: ssl.SSLContext | None = None
        self._subprotocol = SUBPROTOCOLS[codec]
        self._settings = settings

    async def open(self, url: str) -> tuple[ClientConnection, str | None]:
        """Return a WebSocket to *url* and the token that it was opened with; raises DialError.

        A token that is refused is asked for once more, if it comes from a callable.
        """
        token = await self.read_token()
        try:
            return await self._handshake(url, token), token
        except DialError as failed:
            if not callable(self.token) or not isinstance(failed.error, Unauthorized):
                raise
        token = await self.read_token()
        return await self._handshake(url, token), token

    async def read_token(self) -> str | None:
        """Return the token without white space around it, which files and shells add; raises DialError."""
        if not callable(self.token):
            token = self.token
        else:
            try:
                token = await self.token()
            except RsePfError as error:  # its message is written for users, unlike that of any other error
                raise DialError(ConnectError(f"no token: {error.message}", hint=error.hint)) from error
            except Exception as error:
                told = ConnectError(
                    f"no token: the token callable raised {type(error).__name__}",
                    hint="fix the token callable",
                )
                raise DialError(told) from error
        if token is None:
            return None
        try:
            return checked_token(token)
        except Unauthorized as error:
            raise DialError(error, is_final=True) from None

    async def _handshake(self, url: str, token: str | None) -> ClientConnection:
        address, options = shown_address(url), websocket_options(self._settings)
        if self.ssl_context is not None and url.startswith("wss:"):
            options["ssl"] = self.ssl_context
        try:
            websocket = await websocket_connect(
                url,
                subprotocols=[Subprotocol(self._subprotocol)],
                additional_headers={} if token is None else {"Authorization": f"Bearer {token}"},
                **options,
            )
        except InvalidStatus as error:
            told = error.response
            after = told.headers.get("Retry-After", "")
            raise dial_error_of(address, told.status_code, after, bytes(told.body or b"")) from error
        except ssl.SSLCertVerificationError as error:
            raise untrusted(address, error) from error
        except (OSError, asyncio.TimeoutError, WebSocketException, EOFError) as error:
            raise unreachable(address, error) from error
        if websocket.subprotocol != self._subprotocol:
            websocket.transport.abort()
            unsupported = UnsupportedProtocol(
                f"{address} does not speak {self._subprotocol}", hint=CHECK_ADDRESS
            )
            raise DialError(unsupported, is_wrong_address=True)
        return websocket
