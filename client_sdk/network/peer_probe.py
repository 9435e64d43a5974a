"""Ask a peer that gave no usable answer again: does it speak TLS, of which authority, and what without TLS?

It is asked without a token.  Blocking, for at most twice the timeout; `foreign_answers` explains the
result.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import time
from dataclasses import dataclass
from urllib.parse import SplitResult

from client_sdk.network.http_proxy import TunnelRefused, check_tunnel, is_complete_head, proxy_of
from client_sdk.network.peer_diagnosis import explain_proxy
from rse_pf.errors import RsePfError

__all__ = ["Probed", "dial", "port_of", "probe"]

_COMMON_NAME = b"\x55\x04\x03"  # DER of the object identifier id-at-commonName (RFC 5280, A.1)
_ORGANISATION = b"\x55\x04\x0a"  # the same of id-at-organizationName
_VERSION = 0xA0  # tag of the optional first field of a certificate
_ENOUGH_BYTES = 4096
"""Of an answer without TLS: its head, and the begin of a page."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Probed:
    """A peer's ``certificate`` (DER, None without TLS) and its first ``data`` without TLS."""

    certificate: bytes | None = None
    data: bytes = b""

    @property
    def issuer(self) -> str:
        """The name of the authority that signed the certificate, empty if it cannot be read."""
        with contextlib.suppress(IndexError, ValueError):
            return "" if self.certificate is None else _issuer(self.certificate)
        return ""


def port_of(parts: SplitResult) -> int:
    """Return the port of an address, that of its scheme if it names none."""
    return parts.port or (443 if parts.scheme in ("wss", "https") else 80)


def dial(parts: SplitResult, timeout_s: float) -> socket.socket:
    """Return a TCP connection to the host of *parts*, through the proxy of the environment if it has one.

    Connecting to the proxy and its answer take at most *timeout_s* each.

    Raises:
        OSError: There is no connection to the host.
        TunnelRefused: The proxy opens none, or cannot be reached.
        UsageError: The variable of the proxy names none.
    """
    host, port = parts.hostname or "", port_of(parts)
    proxy = proxy_of(parts.scheme, host, port)
    if proxy is None:
        return socket.create_connection((host, port), timeout_s)
    address = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}"
    try:
        made = socket.create_connection((proxy.host, proxy.port), timeout_s)
        try:
            made.sendall(proxy.connect_request(host, port))
            check_tunnel(address, proxy, _read_head(made, time.monotonic() + timeout_s))
            made.settimeout(timeout_s)
        except BaseException:
            made.close()
            raise
    except OSError as error:
        explained = explain_proxy(address, proxy.shown, proxy.variable, None, has_credentials=False)
        raise TunnelRefused(explained, is_lasting=False) from error
    return made


def probe(parts: SplitResult, timeout_s: float) -> Probed:
    """Return what the peer at *parts* shows with TLS, or else what it sends without, in *timeout_s* each."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    deadline = time.monotonic() + timeout_s
    with (
        contextlib.suppress(OSError, ValueError, RsePfError, TunnelRefused),
        _dial_until(parts, deadline) as made,
        context.wrap_socket(made, server_hostname=parts.hostname) as secured,
    ):
        return Probed(certificate=secured.getpeercert(binary_form=True) or b"")
    data, host = b"", parts.netloc.rpartition("@")[2]
    deadline = time.monotonic() + timeout_s
    with (
        contextlib.suppress(OSError, ValueError, RsePfError, TunnelRefused),
        _dial_until(parts, deadline) as made,
    ):
        request = f"GET {parts.path or '/'} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
        made.sendall(request.encode("ascii", "ignore"))
        while len(data) < _ENOUGH_BYTES and (more := _receive(made, _ENOUGH_BYTES, deadline)):
            data += more
    return Probed(data=data)


def _dial_until(parts: SplitResult, deadline: float) -> socket.socket:
    made = dial(parts, deadline - time.monotonic())
    _limit(made, deadline)
    return made


def _limit(made: socket.socket, deadline: float) -> None:
    """Let the next operation, whose parts share one timeout, end at *deadline* of the monotonic clock."""
    made.settimeout(max(0.001, deadline - time.monotonic()))  # 0 would mean without blocking


def _receive(made: socket.socket, max_bytes: int, deadline: float) -> bytes:
    if time.monotonic() >= deadline:
        raise TimeoutError("the peer sends too slowly")
    _limit(made, deadline)
    return made.recv(max_bytes)


def _read_head(made: socket.socket, deadline: float) -> bytes:
    """Read byte by byte: what follows the head belongs to the server behind the proxy."""
    head = b""
    while not is_complete_head(head) and (byte := _receive(made, 1, deadline)):
        head += byte
    return head


def _issuer(certificate: bytes) -> str:
    """Return common name and organisation of the issuer (RFC 5280, 4.1): ``Name (Organisation)``."""
    _, begin, _ = _element(certificate, 0)
    tag, begin, _ = _element(certificate, begin)
    tag, _, after = _element(certificate, begin)
    if tag == _VERSION:
        tag, _, after = _element(certificate, after)
    _, _, after = _element(certificate, after)  # the algorithm of the signature, behind the serial number
    _, at, end = _element(certificate, after)
    names: dict[bytes, str] = {}
    while at < end:
        _, inner, at = _element(certificate, at)
        _, inner, _ = _element(certificate, inner)
        _, begin, until = _element(certificate, inner)
        _, value, value_end = _element(certificate, until)
        names[certificate[begin:until]] = certificate[value:value_end].decode("utf-8", "replace")
    name, organisation = names.get(_COMMON_NAME, ""), names.get(_ORGANISATION, "")
    return f"{name} ({organisation})" if name and organisation else name or organisation


def _element(data: bytes, at: int) -> tuple[int, int, int]:
    """Return tag, begin and end of the content of the DER element at *at* (X.690, 8.1)."""
    length, begin = data[at + 1], at + 2
    if length & 0x80:
        count = length & 0x7F
        length = int.from_bytes(data[begin : begin + count], "big")
        begin += count
    return data[at], begin, begin + length
