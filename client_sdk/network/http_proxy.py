"""The HTTP proxy of the environment: which one, for which hosts, and the tunnel (CONNECT) through it.

Variables are read by the standard library as other programs read them: ``HTTP_PROXY``, ``HTTPS_PROXY``,
``ALL_PROXY`` and ``NO_PROXY``, in upper or lower case.  Nothing here opens a socket.
"""

from __future__ import annotations

import base64
import ipaddress
import urllib.request
from dataclasses import dataclass, field
from urllib.parse import unquote, urlsplit

from client_sdk.network.peer_diagnosis import explain_proxy, parse_answer
from rse_pf.config.placement import is_loopback
from rse_pf.errors import ConnectError, UsageError

__all__ = ["MAX_HEAD_BYTES", "Proxy", "TunnelRefused", "check_tunnel", "is_complete_head", "proxy_of"]

MAX_HEAD_BYTES = 8192
"""A longer answer to CONNECT is none of a proxy; proxies and servers limit heads to the same size."""
_DEFAULT_PORT = 80
_KINDS = {"ws": "http", "http": "http", "wss": "https", "https": "https"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Proxy:
    """A proxy and the variable that names it; ``authorization`` is a header's value and never shown."""

    variable: str
    host: str
    port: int
    authorization: str = field(default="", repr=False)

    @property
    def shown(self) -> str:
        """The address without user name and password."""
        return f"http://{_bracketed(self.host)}:{self.port}"

    def connect_request(self, host: str, port: int) -> bytes:
        """Return the request for a tunnel to *host* (RFC 9110, 9.3.6)."""
        target = f"{_bracketed(host).encode('idna').decode()}:{port}"
        credentials = f"Proxy-Authorization: {self.authorization}\r\n" if self.authorization else ""
        return f"CONNECT {target} HTTP/1.1\r\nHost: {target}\r\n{credentials}\r\n".encode()


class TunnelRefused(Exception):
    """A proxy that opens no tunnel; ``is_lasting`` says that another attempt gets the same answer."""

    def __init__(self, error: ConnectError, *, is_lasting: bool) -> None:
        super().__init__(error.message)
        self.error = error
        self.is_lasting = is_lasting


def proxy_of(scheme: str, host: str, port: int) -> Proxy | None:
    """Return the proxy for *host*, None if the connection is direct; loopback is always direct.

    Raises:
        UsageError: The variable names no HTTP proxy.
    """
    proxies = urllib.request.getproxies()
    name = next((name for name in (_KINDS[scheme], "all") if proxies.get(name)), None)
    if name is None or is_loopback(host) or _is_exempt(host, port, proxies.get("no", "")):
        return None
    return _parse(proxies[name], f"{name.upper()}_PROXY")


def is_complete_head(head: bytes) -> bool:
    """Return whether the answer to CONNECT is complete, or longer than an answer can be."""
    return b"\r\n\r\n" in head or b"\n\n" in head or len(head) >= MAX_HEAD_BYTES


def check_tunnel(address: str, proxy: Proxy, head: bytes) -> None:
    """Raise TunnelRefused unless *head*, the answer of *proxy*, opens the tunnel to *address*."""
    answer = parse_answer(head)
    if answer is None or answer.status // 100 != 2:
        error = explain_proxy(
            address, proxy.shown, proxy.variable, answer, has_credentials=bool(proxy.authorization)
        )
        raise TunnelRefused(error, is_lasting=answer is not None and answer.status // 100 == 4)


def _parse(value: str, variable: str) -> Proxy:
    try:
        parts = urlsplit(value if "://" in value else f"http://{value}")
        host, port = parts.hostname, parts.port or _DEFAULT_PORT
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
    """Return whether NO_PROXY has *host*: a name, a suffix, one with a port, or a network (CIDR)."""
    if urllib.request.proxy_bypass(f"{_bracketed(host)}:{port}"):
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    return any(address in network for network in map(_network, exempt.split(",")) if network is not None)


def _network(entry: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network | None:
    try:
        return ipaddress.ip_network(entry.strip().strip("[]"), strict=False)
    except ValueError:
        return None


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
