"""Probe a peer that gave no usable answer: does it speak TLS, and what does it send without TLS?

The probe makes new connections without a token.  It blocks for at most twice its timeout.
`client_sdk.network.peer_diagnosis` explains the result.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import time
from dataclasses import dataclass
from urllib.parse import SplitResult

from client_sdk.network.http_proxy import TunnelRefused, connect_tcp, receive_until
from rse_pf.errors import RsePfError

__all__ = ["PeerProbe", "probe_peer"]

COMMON_NAME_OID = b"\x55\x04\x03"
"""DER bytes of the object identifier id-at-commonName (RFC 5280, A.1)."""
ORGANISATION_OID = b"\x55\x04\x0a"
"""DER bytes of the object identifier id-at-organizationName (RFC 5280, A.1)."""
VERSION_TAG = 0xA0
"""DER tag of the version, the optional first field of a certificate (RFC 5280, 4.1)."""
MAX_ANSWER_BYTES = 4096
"""How much of an answer to plain HTTP is read: its head and the beginning of a page tell who answers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerProbe:
    """What a peer showed: its TLS ``certificate`` (DER), or else the first ``data`` that it sent without
    TLS."""

    certificate: bytes | None = None
    data: bytes = b""

    @property
    def issuer(self) -> str:
        """Name of the authority that signed the certificate, empty without a readable certificate."""
        with contextlib.suppress(IndexError, ValueError):
            return "" if self.certificate is None else _read_issuer(self.certificate)
        return ""


def probe_peer(parts: SplitResult, timeout_s: float) -> PeerProbe:
    """Return what the peer at the address *parts* shows.

    Each of the two steps takes at most *timeout_s* seconds; a step that fails shows nothing, and nothing is
    raised.
    """
    # 1. Try a TLS handshake, whatever the certificate is.
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    with (
        contextlib.suppress(OSError, ValueError, RsePfError, TunnelRefused),
        _connect_until(parts, time.monotonic() + timeout_s) as connection,
        context.wrap_socket(connection, server_hostname=parts.hostname) as secured,
    ):
        return PeerProbe(certificate=secured.getpeercert(binary_form=True) or b"")
    # 2. Send a plain HTTP request, and read the beginning of the answer.
    data, host = b"", parts.netloc.rpartition("@")[2]
    deadline_s = time.monotonic() + timeout_s
    with (
        contextlib.suppress(OSError, ValueError, RsePfError, TunnelRefused),
        _connect_until(parts, deadline_s) as connection,
    ):
        request = f"GET {parts.path or '/'} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
        connection.sendall(request.encode("ascii", "ignore"))
        while len(data) < MAX_ANSWER_BYTES and (
            received := receive_until(connection, MAX_ANSWER_BYTES, deadline_s)
        ):
            data += received
    return PeerProbe(data=data)


def _connect_until(parts: SplitResult, deadline_s: float) -> socket.socket:
    """Return a TCP connection whose next operation ends at *deadline_s* of the monotonic clock."""
    connection = connect_tcp(parts, deadline_s - time.monotonic())
    # A timeout of 0 would make the socket non-blocking.
    connection.settimeout(max(0.001, deadline_s - time.monotonic()))
    return connection


def _read_issuer(certificate: bytes) -> str:
    """Return common name and organisation of the issuer of a DER certificate, as ``Name (Organisation)``.

    Source: RFC 5280, Sect. 4.1, and X.690, Sect. 8.1.  Raises IndexError for a malformed certificate.
    """
    # 1. Enter the certificate and its first part, the data that is signed.
    _, begin, _ = _read_element(certificate, 0)
    _, begin, _ = _read_element(certificate, begin)
    # 2. Skip the version, the serial number and the algorithm of the signature.
    tag, _, after = _read_element(certificate, begin)
    if tag == VERSION_TAG:
        _, _, after = _read_element(certificate, after)
    _, _, after = _read_element(certificate, after)
    # 3. Read the parts of the issuer's name.
    _, at, end = _read_element(certificate, after)
    values: dict[bytes, str] = {}
    while at < end:
        _, name_set, at = _read_element(certificate, at)
        _, name_pair, _ = _read_element(certificate, name_set)
        _, oid_begin, oid_end = _read_element(certificate, name_pair)
        _, value_begin, value_end = _read_element(certificate, oid_end)
        values[certificate[oid_begin:oid_end]] = certificate[value_begin:value_end].decode("utf-8", "replace")
    name, organisation = values.get(COMMON_NAME_OID, ""), values.get(ORGANISATION_OID, "")
    return f"{name} ({organisation})" if name and organisation else name or organisation


def _read_element(data: bytes, at: int) -> tuple[int, int, int]:
    """Return the tag, and begin and end of the content, of the DER element at offset *at* (X.690, 8.1)."""
    length, begin = data[at + 1], at + 2
    if length & 0x80:
        size = length & 0x7F
        length = int.from_bytes(data[begin : begin + size], "big")
        begin += size
    return data[at], begin, begin + length
