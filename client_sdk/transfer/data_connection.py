"""Send one HTTP request at a time to the data service, with the robot's token and typed errors.

A request is sent once; repeats belong to `client_sdk.transfer.data_client`.
"""

from __future__ import annotations

import http.client
import json
import socket
import ssl
from typing import TypeVar
from urllib.parse import SplitResult

import msgspec

from client_sdk.network.bearer_token import strip_token
from client_sdk.network.dial_errors import DialError, explain_tcp_failure, show_wrong_url, split_address
from client_sdk.network.http_proxy import find_proxy, open_tunnel, port_of
from client_sdk.network.peer_diagnosis import (
    WEB_SCHEME,
    HttpAnswer,
    explain_answer,
    explain_certificate,
    explain_no_answer,
    is_plain_peer,
)
from rse_pf.errors import (
    ConnectError,
    RsePfError,
    UsageError,
    error_from_code,
)

__all__ = [
    "MAX_SINGLE_PUT_BYTES",
    "NO_UPSTREAM",
    "DataConnection",
    "Response",
    "StoredReply",
    "open_connection",
]

MAX_SINGLE_PUT_BYTES = 262_144
"""Largest object, in bytes, that is sent in one request; larger ones are sent in parts that can be
resumed."""
NO_UPSTREAM = b"no healthy upstream"
"""Body of the 503 that the load balancer (Envoy) sends while it knows no data server at all."""
Response = tuple[int, http.client.HTTPMessage, bytes]
"""HTTP status, headers and body of an answer."""
T = TypeVar("T")


class StoredReply(msgspec.Struct, frozen=True, kw_only=True):
    """Fields of every reply about one object: its sha256 in hexadecimal, and its size in bytes."""

    digest: str
    size: int


class DataConnection:
    """Keep one HTTP connection to the data service; one thread may use it at a time."""

    def __init__(self, url: str, *, timeout_s: float, ssl_context: ssl.SSLContext | None) -> None:
        """Store the arguments; nothing is sent yet.

        Args:
            url: Address of the data service, ``http://HOST:PORT`` or ``https://...``; or the ``ws:`` or
                ``wss:`` address of the backend servers, at whose host and port the data service is, too.
            timeout_s: How long one request may wait for the next bytes of its answer, in seconds.
            ssl_context: TLS context for ``https:``; None trusts the authorities of the machine.

        Raises:
            UsageError: *url* has another scheme, or no usable host or port.
        """
        error = UsageError(
            f"{show_wrong_url(url)!r} is not an address of a data service", hint="write https://HOST"
        )
        parts = split_address(url, ("http", "https", "ws", "wss"), error)
        scheme = WEB_SCHEME[parts.scheme]
        netloc = parts.netloc.rpartition("@")[2]
        self._parts = SplitResult(scheme, netloc, "", "", "")
        self.uses_tls = scheme == "https"
        self.host = self._parts.hostname or ""
        self.is_wrong_address = False
        """Whether the last request failed in a way that a repeat cannot help: the scheme of the address is
        wrong for the peer (TLS or not), its certificate is not trusted, or the HTTP proxy refuses the
        request."""
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
        """Send one request and return its answer, whatever its status.

        Raises:
            ConnectError: There is no answer.
            Unauthorized: *token* is not a text, is empty, or has characters that no token has.
            UsageError: The environment variable for the proxy does not hold the address of an HTTP proxy.
        """
        authorization = {"Authorization": f"Bearer {strip_token(token)}"}
        self.is_wrong_address = False
        try:
            if self._connection is None:
                self._connection = open_connection(self._parts, self._timeout_s, self._ssl_context)
            self._connection.request(method, path, body, {**authorization, **headers})
            answer = self._connection.getresponse()
            body_received = answer.read()
        except DialError as refused:
            self.is_wrong_address = refused.is_wrong_address
            raise refused.error from None
        except (OSError, http.client.HTTPException) as error:
            self.close()
            raise self._explain_no_answer(error) from error
        if answer.will_close:
            self.close()
        self._has_answered = True
        return answer.status, answer.headers, body_received

    def failure(
        self,
        status: int,
        headers: http.client.HTTPMessage,
        content: bytes,
        expected: tuple[int, ...] = (),
    ) -> RsePfError | None:
        """Return the typed error of an answer; None for a status below 300 or an *expected* status.

        The answer of a login page or a proxy is an error whatever its status; `HttpAnswer.is_foreign`
        recognises it by a status or a content type that the data service never sends.
        """
        answer = _answer_of(status, headers, content)
        if not answer.is_foreign and (status < 300 or status in expected):
            return None
        if content == NO_UPSTREAM:
            return self._no_service_error()
        error = None if answer.is_foreign else _error_of(content)
        return error or explain_answer(self._parts.geturl(), answer)

    def decode(self, response: Response, kind: type[T], digest: str = "") -> T:
        """Return the reply in the answer to a successful request.

        Args:
            response: The answer.
            kind: Type of the reply; `bytes` returns the body as it is.
            digest: The sha256 that a `StoredReply` must name; empty for any.

        Raises:
            ConnectError: The body is not a reply of this type about this object, so another program answered.
        """
        if kind is bytes:
            return response[2]  # type: ignore[return-value]
        try:
            reply = msgspec.json.decode(response[2], type=kind)
        except (ValueError, RecursionError):  # msgspec.DecodeError and UnicodeDecodeError are ValueErrors
            reply = None
        is_of_other_object = isinstance(reply, StoredReply) and digest not in ("", reply.digest)
        if reply is None or is_of_other_object:
            raise explain_answer(self._parts.geturl(), _answer_of(*response))
        return reply

    def _no_service_error(self) -> ConnectError:
        return ConnectError(
            f"the platform at {self.host} has no data service",
            hint="start rse-pf local without --no-data; in a cloud, set data.enabled",
        )

    def _explain_no_answer(self, error: OSError | http.client.HTTPException) -> ConnectError:
        """Return the typed error of a request without an answer.

        If the peer has never answered, the error says what may be wrong with the address.
        """
        address = self._parts.geturl()
        if isinstance(error, ssl.SSLCertVerificationError):
            self.is_wrong_address = True
            return explain_certificate(address, error, is_enrolled=self._ssl_context is not None)
        if not self._has_answered:
            has_text = isinstance(error, http.client.BadStatusLine) and not isinstance(error, OSError)
            first_bytes = str(error).encode("latin-1", "replace") if has_text else b""
            self.is_wrong_address = has_text or is_plain_peer(error)
            return explain_no_answer(address, error, first_bytes=first_bytes, within_s=self._timeout_s)
        return ConnectError(
            f"no answer from {self.host}: {error or type(error).__name__}",
            hint="call again to resume the transfer",
        )


def open_connection(
    parts: SplitResult, timeout_s: float, ssl_context: ssl.SSLContext | None = None
) -> http.client.HTTPConnection:
    """Open a connection to the host of *parts*, through the HTTP proxy that the environment names, if any.

    Raises:
        ConnectError: There is no TCP connection.
        OSError: The TLS handshake failed.
        DialError: The proxy opens no tunnel, or cannot be reached.
        UsageError: The environment variable for the proxy does not hold the address of an HTTP proxy.
    """
    host, port = parts.hostname or "", port_of(parts)
    connection = http.client.HTTPConnection(host, port, timeout=timeout_s)
    connection.auto_open = 0  # http.client would connect again without the proxy
    proxy = find_proxy(parts.scheme, host, port)
    try:
        if proxy is None:
            tcp = socket.create_connection((host, port), timeout_s)
        else:
            tcp = open_tunnel(proxy, parts, timeout_s)
    except OSError as error:
        raise explain_tcp_failure(parts._replace(path="", query="").geturl(), error) from error
    tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if parts.scheme == "https":
        try:
            context = ssl_context or ssl.create_default_context()
            tcp = context.wrap_socket(tcp, server_hostname=host)
        except BaseException:
            tcp.close()
            raise
        connection.default_port = http.client.HTTPS_PORT  # the header Host then omits the port
    connection.sock = tcp
    return connection


def _answer_of(status: int, headers: http.client.HTTPMessage, content: bytes) -> HttpAnswer:
    lower = {name.lower(): value for name, value in headers.items()}
    return HttpAnswer(status=status, headers=lower, body=content)


def _error_of(content: bytes) -> RsePfError | None:
    """Return the typed error in the body of an answer; None if the data service did not write it."""
    try:
        error = json.loads(content)
        return error_from_code(str(error["code"]), str(error["message"]), hint=str(error.get("hint", "")))
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
