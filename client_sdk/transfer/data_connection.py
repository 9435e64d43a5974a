"""One request to the data service at a time, by HTTP: connection, token and typed errors, without repeats."""

from __future__ import annotations

import http.client
import json
import socket
import ssl
from typing import TypeVar
from urllib.parse import SplitResult

import msgspec

from client_sdk.network.bearer_token import strip_token
from client_sdk.network.dial_errors import explain_unconnected, show_wrong_url, split_address
from client_sdk.network.http_proxy import TunnelRefused
from client_sdk.network.peer_diagnosis import (
    HttpAnswer,
    explain_answer,
    explain_certificate,
    explain_silence,
    is_of_tls_server,
)
from client_sdk.network.peer_probe import dial, port_of, probe
from rse_pf.errors import (
    ConnectError,
    RsePfError,
    UsageError,
    error_from_code,
)

__all__ = [
    "MAX_SINGLE_PUT_BYTES",
    "NO_UPSTREAM",
    "DataRequests",
    "Response",
    "StoredReply",
    "open_connection",
]

MAX_SINGLE_PUT_BYTES = 262_144
"""Larger objects are sent in parts."""
NO_UPSTREAM = b"no healthy upstream"
"""The body of the load balancer's 503 while it knows no data server at all."""
_PROBE_S = 1.0
"""How long a peer that gave no usable answer may take when it is asked again; a live one needs less."""
_HTTP_SCHEMES = {"ws": "http", "wss": "https"}
Response = tuple[int, http.client.HTTPMessage, bytes]
T = TypeVar("T")


class StoredReply(msgspec.Struct, frozen=True, kw_only=True):
    """The begin of every reply about an object: its sha256 and its length."""

    digest: str
    size: int


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
        error = UsageError(
            f"{show_wrong_url(url)!r} is not an address of a data service", hint="write https://HOST"
        )
        parts = split_address(url, ("http", "https", "ws", "wss"), error)
        scheme = _HTTP_SCHEMES.get(parts.scheme, parts.scheme)
        netloc = parts.netloc.rpartition("@")[2]
        self._parts = SplitResult(scheme, netloc, "", "", "")
        self.secure = scheme == "https"
        self.host = self._parts.hostname or ""
        self.is_wrong_address = False
        """Whether the last request failed in a way that only another address or setting changes."""
        self._has_answered = False
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
        self.is_wrong_address = False
        try:
            if self._connection is None:
                self._connection = open_connection(self._parts, self._timeout_s, self._ssl_context)
            self._connection.request(method, path, body, {**authorization, **headers})
            answer = self._connection.getresponse()
            content = answer.read()
        except TunnelRefused as refused:
            self.is_wrong_address = refused.is_lasting
            raise refused.error from None
        except (OSError, http.client.HTTPException) as broken:
            self.close()
            raise self._explain(broken) from broken
        if answer.will_close:
            self.close()
        self._has_answered = True
        return answer.status, answer.headers, content

    def failure(
        self,
        status: int,
        headers: http.client.HTTPMessage,
        content: bytes,
        also: tuple[int, ...] = (),
    ) -> RsePfError | None:
        """Return the typed error of an answer, None if it is a success, or the caller expects its status.

        Login pages and proxies answer with 200 and redirects, too; none of their answers is a success.
        """
        answer = _answer_of(status, headers, content)
        if not answer.is_foreign and (status < 300 or status in also):
            return None
        if content == NO_UPSTREAM:
            return self.no_service()
        error = None if answer.is_foreign else _error_of(content)
        return error or explain_answer(self._parts.geturl(), answer)

    def decode(self, response: Response, kind: type[T], digest: str = "") -> T:
        """Return the reply in a success, of an object with *digest* if it is given; bytes are not decoded.

        Raises:
            ConnectError: The data service does not write this: somebody else answered.
        """
        if kind is bytes:
            return response[2]  # type: ignore[return-value]
        try:
            reply = msgspec.json.decode(response[2], type=kind)
        except (ValueError, RecursionError):  # msgspec.DecodeError and UnicodeDecodeError are ValueErrors
            reply = None
        is_other = isinstance(reply, StoredReply) and digest not in ("", reply.digest)
        if reply is None or is_other:
            raise explain_answer(self._parts.geturl(), _answer_of(*response))
        return reply

    def no_service(self) -> ConnectError:
        """Return what `NO_UPSTREAM` means."""
        return ConnectError(
            f"the platform at {self.host} has no data service",
            hint="start rse-pf local without --no-data; in a cloud, set data.enabled",
        )

    def _explain(self, broken: OSError | http.client.HTTPException) -> ConnectError:
        """Return what it means that a request has no answer; a peer that never gave one is asked again."""
        address = self._parts.geturl()
        if isinstance(broken, ssl.SSLCertVerificationError):
            self.is_wrong_address = True
            return explain_certificate(
                address, broken, issuer=probe(self._parts, _PROBE_S).issuer,
                is_enrolled=self._ssl_context is not None,
            )  # fmt: skip
        if not self._has_answered:
            known = probe(self._parts, _PROBE_S)
            data, speaks_tls = known.data, known.certificate is not None
            if isinstance(broken, http.client.BadStatusLine) and not isinstance(broken, ConnectionResetError):
                data = data or str(broken).encode("latin-1", "replace")
            has_other = bool(data) and not is_of_tls_server(data)
            self.is_wrong_address = self.secure != speaks_tls and (speaks_tls or has_other)
            return explain_silence(
                address, broken, certificate=known.certificate, data=data, within_s=self._timeout_s
            )
        return ConnectError(
            f"no answer from {self.host}: {broken or type(broken).__name__}",
            hint="call again to resume the transfer",
        )


def open_connection(
    parts: SplitResult, timeout_s: float, ssl_context: ssl.SSLContext | None = None
) -> http.client.HTTPConnection:
    """Return a connection to the host of *parts*, through the proxy of the environment if it has one.

    Raises:
        ConnectError: There is no connection.
        OSError: TLS fails.
        TunnelRefused: The proxy opens none.
        UsageError: The variable of the proxy names none.
    """
    host, port = parts.hostname or "", port_of(parts)
    made = http.client.HTTPConnection(host, port, timeout=timeout_s)
    made.auto_open = 0  # it would not know the proxy
    try:
        connected = dial(parts, timeout_s)
    except OSError as error:
        raise explain_unconnected(parts._replace(path="", query="").geturl(), error) from error
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if parts.scheme == "https":
        try:
            context = ssl_context or ssl.create_default_context()
            connected = context.wrap_socket(connected, server_hostname=host)
        except BaseException:
            connected.close()
            raise
        made.default_port = http.client.HTTPS_PORT  # of the header Host
    made.sock = connected
    return made


def _answer_of(status: int, headers: http.client.HTTPMessage, content: bytes) -> HttpAnswer:
    lower = {name.lower(): value for name, value in headers.items()}
    return HttpAnswer(status=status, headers=lower, body=content)


def _error_of(content: bytes) -> RsePfError | None:
    """Return the typed error in the body of a refusal, None if the data service did not write it."""
    try:
        error = json.loads(content)
        return error_from_code(str(error["code"]), str(error["message"]), hint=str(error.get("hint", "")))
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
