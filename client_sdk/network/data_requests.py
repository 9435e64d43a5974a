"""One request to the data service at a time, by HTTP: connection, token and typed errors, without repeats."""

from __future__ import annotations

import http.client
import json
import ssl
from urllib.parse import urlsplit

from client_sdk.token_text import strip_token
from rse_pf.errors import (
    BadRequest,
    CommandFailed,
    ConnectError,
    NotFound,
    RsePfError,
    UsageError,
    error_from_code,
)

__all__ = ["CONNECTIONS", "MAX_SINGLE_PUT_BYTES", "NO_UPSTREAM", "DataRequests", "Response", "error_of"]

MAX_SINGLE_PUT_BYTES = 262_144
"""Larger objects are sent in parts."""
NO_UPSTREAM = b"no healthy upstream"
"""The body of the load balancer's 503 while it knows no data server at all."""
CONNECTIONS = {True: http.client.HTTPSConnection, False: http.client.HTTPConnection}

Response = tuple[int, http.client.HTTPMessage, bytes]


class DataRequests:
    """A connection to the data service; used by one thread at a time."""

    def __init__(self, url: str, *, timeout_s: float, ssl_context: ssl.SSLContext | None) -> None:
        """Store the address; nothing is sent yet.

        Args:
            url: ``http://HOST:PORT`` or ``https://...``, or the ``ws:`` or ``wss:`` address of the servers.
            timeout_s: Of one answer.
            ssl_context: For ``https:``; None trusts the authorities of the machine.

        Raises:
            UsageError: *url* is not such an address.
        """
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https", "ws", "wss") or not parts.hostname:
            raise UsageError(f"{url!r} is not an address of a data service", hint="write https://HOST")
        self.secure = parts.scheme in ("https", "wss")
        self.host, self._port = parts.hostname, parts.port
        self._timeout_s, self._ssl_context = timeout_s, ssl_context
        self._connection: http.client.HTTPConnection | None = None

    def close(self) -> None:
        """Close the connection; the next request opens another."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def request(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str], token: object
    ) -> Response:
        """Return the answer to one request.

        Raises:
            ConnectError: There is none.
            Unauthorized: *token* is no text of a token.
        """
        authorization = {"Authorization": f"Bearer {strip_token(token)}"}
        try:
            if self._connection is None:
                self._connection = self._new_connection()
            self._connection.request(method, path, body, {**authorization, **headers})
            answer = self._connection.getresponse()
            content = answer.read()
        except (OSError, http.client.HTTPException) as broken:
            self.close()
            raise ConnectError(
                f"no answer from {self.host}: {broken or type(broken).__name__}",
                hint="call again to resume the transfer",
            ) from broken
        if answer.will_close:
            self.close()
        return answer.status, answer.headers, content

    def no_service(self) -> ConnectError:
        """Return what `NO_UPSTREAM` means."""
        return ConnectError(
            f"the platform at {self.host} has no data service",
            hint="start rse-pf local without --no-data; in a cloud, set data.enabled",
        )

    def _new_connection(self) -> http.client.HTTPConnection:
        if self.secure and self._ssl_context is not None:
            return http.client.HTTPSConnection(
                self.host, self._port, timeout=self._timeout_s, context=self._ssl_context
            )
        made: http.client.HTTPConnection = CONNECTIONS[self.secure](
            self.host, self._port, timeout=self._timeout_s
        )
        return made


def error_of(status: int, content: bytes) -> RsePfError:
    """Return the typed error of an answer of *status* 400 or above."""
    try:
        error = json.loads(content)
        return error_from_code(str(error["code"]), str(error["message"]), hint=str(error.get("hint", "")))
    except (ValueError, KeyError, TypeError):
        kind = NotFound if status == 404 else BadRequest if status < 500 else CommandFailed
        return kind(f"the data service answered {status}", hint="see the log of the data server")
