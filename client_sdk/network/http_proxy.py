"""Connect through the HTTP proxy that the environment names, if it names one for the host.

The standard library reads the variables ``HTTP_PROXY``, ``HTTPS_PROXY``, ``ALL_PROXY`` and ``NO_PROXY``, in
upper or lower case, as other programs do.  A tunnel through the proxy is opened by CONNECT (RFC 9110, 9.3.6).
"""

from __future__ import annotations

import base64
import ipaddress
import socket
import time
import urllib.request
from dataclasses import dataclass, field
from urllib.parse import SplitResult, unquote, urlsplit

from client_sdk.network.peer_diagnosis import explain_proxy, parse_answer
from rse_pf.config.placement import is_loopback
from rse_pf.errors import ConnectError, UsageError

__all__ = [
    "MAX_HEAD_BYTES",
    "Proxy",
    "TunnelRefused",
    "check_tunnel",
    "connect_tcp",
    "find_proxy",
    "is_complete_head",
    "port_of",
    "receive_until",
]

MAX_HEAD_BYTES = 8192
"""Longest answer of a proxy to CONNECT, in bytes; proxies and servers limit request heads to the same
size."""
DEFAULT_PROXY_PORT = 80
"""Port of a proxy whose address names none."""
PROXY_SCHEMES = {"ws": "http", "http": "http", "wss": "https", "https": "https"}
"""For each URL scheme the one whose variable names the proxy: ``ws:`` uses ``HTTP_PROXY``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Proxy:
    """An HTTP proxy and the variable that names it; ``authorization`` is a header value that is never
    shown."""

    variable: str
    host: str
    port: int
    authorization: str = field(default="", repr=False)

    @property
    def shown_url(self) -> str:
        """The address of the proxy without user name and password."""
        return f"http://{_bracket_ipv6(self.host)}:{self.port}"

    def connect_request(self, host: str, port: int) -> bytes:
        """Return the bytes of a CONNECT request for a tunnel to *host* (RFC 9110, 9.3.6)."""
        target = f"{_bracket_ipv6(host).encode('idna').decode()}:{port}"
        credentials = f"Proxy-Authorization: {self.authorization}\r\n" if self.authorization else ""
        return f"CONNECT {target} HTTP/1.1\r\nHost: {target}\r\n{credentials}\r\n".encode()


class TunnelRefused(Exception):
    """A proxy opened no tunnel; ``is_lasting`` says whether another attempt would get the same answer."""

    def __init__(self, error: ConnectError, *, is_lasting: bool) -> None:
        """Carry the typed *error* for the user."""
        super().__init__(error.message)
        self.error = error
        self.is_lasting = is_lasting


def port_of(parts: SplitResult) -> int:
    """Return the port of an address, 443 or 80 by its scheme if it names none."""
    return parts.port or (443 if parts.scheme in ("wss", "https") else 80)


def connect_tcp(parts: SplitResult, timeout_s: float) -> socket.socket:
    """Return a TCP connection to the host of *parts*, through the proxy of the environment if it has one.

    This function blocks.  The connection to a proxy and the proxy's answer take at most *timeout_s* seconds
    each.

    Raises:
        OSError: There is no connection to the host.
        TunnelRefused: The proxy refuses the tunnel, or cannot be reached.
        UsageError: The environment variable names no HTTP proxy.
    """
    host, port = parts.hostname or "", port_of(parts)
    proxy = find_proxy(parts.scheme, host, port)
    if proxy is None:
        return socket.create_connection((host, port), timeout_s)
    address = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}"
    try:
        connection = socket.create_connection((proxy.host, proxy.port), timeout_s)
        try:
            connection.sendall(proxy.connect_request(host, port))
            check_tunnel(address, proxy, _read_head(connection, time.monotonic() + timeout_s))
            connection.settimeout(timeout_s)
        except BaseException:
            connection.close()
            raise
    except OSError as error:
        explained = explain_proxy(address, proxy.shown_url, proxy.variable, None, has_credentials=False)
        raise TunnelRefused(explained, is_lasting=False) from error
    return connection


def receive_until(connection: socket.socket, max_bytes: int, deadline_s: float) -> bytes:
    """Return at most *max_bytes* that arrive next, empty at the end; *deadline_s* is of the monotonic clock.

    Raises:
        TimeoutError: The deadline has passed.
    """
    if time.monotonic() >= deadline_s:
        raise TimeoutError("the peer sends too slowly")
    # A timeout of 0 would make the socket non-blocking.
    connection.settimeout(max(0.001, deadline_s - time.monotonic()))
    return connection.recv(max_bytes)


def find_proxy(scheme: str, host: str, port: int) -> Proxy | None:
    """Return the proxy that the environment names for *host*; None for a direct connection.

    Hosts that are exempt by ``NO_PROXY`` and addresses of this machine (loopback) are reached directly.

    Raises:
        UsageError: The environment variable names no HTTP proxy.
    """
    proxies = urllib.request.getproxies()
    name = next((name for name in (PROXY_SCHEMES[scheme], "all") if proxies.get(name)), None)
    if name is None or is_loopback(host) or _is_exempt(host, port, proxies.get("no", "")):
        return None
    return _parse_proxy(proxies[name], f"{name.upper()}_PROXY")


def is_complete_head(head: bytes) -> bool:
    """Return whether *head*, the answer to CONNECT so far, is complete or longer than an answer may be."""
    return b"\r\n\r\n" in head or b"\n\n" in head or len(head) >= MAX_HEAD_BYTES


def check_tunnel(address: str, proxy: Proxy, head: bytes) -> None:
    """Raise TunnelRefused unless *head*, the answer of *proxy* to CONNECT, has a status of 2xx.

    A status of 4xx is lasting: another attempt gets the same answer.  *address* is the platform's, for the
    error.
    """
    answer = parse_answer(head)
    if answer is None or answer.status // 100 != 2:
        error = explain_proxy(
            address, proxy.shown_url, proxy.variable, answer, has_credentials=bool(proxy.authorization)
        )
        raise TunnelRefused(error, is_lasting=answer is not None and answer.status // 100 == 4)


def _parse_proxy(value: str, variable: str) -> Proxy:
    try:
        parts = urlsplit(value if "://" in value else f"http://{value}")
        host, port = parts.hostname, parts.port or DEFAULT_PROXY_PORT
        if host is not None:
            host.encode("idna")
    except ValueError:  # UnicodeError is a ValueError, too
        host, port = None, 0
    if host is None or parts.scheme != "http":
        raise UsageError(
            f"{variable} names no HTTP proxy",
            hint=f"set {variable} to http://HOST:PORT, or name the platform's host in NO_PROXY",
        )
    authorization = ""
    if parts.username is not None:
        credentials = f"{unquote(parts.username)}:{unquote(parts.password or '')}".encode()
        authorization = f"Basic {base64.b64encode(credentials).decode()}"
    return Proxy(variable=variable, host=host, port=port, authorization=authorization)


def _is_exempt(host: str, port: int, exempt: str) -> bool:
    """Return whether NO_PROXY lists *host*: as a name, a suffix, a name with a port, or a network (CIDR)."""
    if urllib.request.proxy_bypass(f"{_bracket_ipv6(host)}:{port}"):
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    return any(
        address in network for network in map(_parse_network, exempt.split(",")) if network is not None
    )


def _parse_network(entry: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network | None:
    try:
        return ipaddress.ip_network(entry.strip().strip("[]"), strict=False)
    except ValueError:
        return None


def _bracket_ipv6(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _read_head(connection: socket.socket, deadline_s: float) -> bytes:
    """Return the proxy's answer to CONNECT: complete, or cut off at its limit or where the proxy closed.

    It is read byte by byte: the bytes after it belong to the server behind the proxy.
    """
    head = b""
    while not is_complete_head(head) and (byte := receive_until(connection, 1, deadline_s)):
        head += byte
    return head
