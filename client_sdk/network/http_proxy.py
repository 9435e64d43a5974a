"""Connect through the HTTP proxy that the environment names, if it names one for the host.

The standard library reads the variables ``HTTP_PROXY``, ``HTTPS_PROXY``, ``ALL_PROXY`` and ``NO_PROXY``, in
upper or lower case, as other programs do.  A tunnel through the proxy is opened by CONNECT (RFC 9110, 9.3.6).
"""

from __future__ import annotations

import base64
import http.client
import ipaddress
import socket
import urllib.request
from dataclasses import dataclass, field
from urllib.parse import SplitResult, unquote, urlsplit

from client_sdk.network.dial_errors import ANSWERED_ERRNOS, DialError
from client_sdk.network.peer_diagnosis import WEB_SCHEME, shorten
from rse_pf.config.placement import is_loopback
from rse_pf.errors import ConnectError, UsageError

__all__ = [
    "Proxy",
    "find_proxy",
    "open_tunnel",
    "port_of",
]

DEFAULT_PROXY_PORT = 80
"""Port of a proxy whose address names none."""


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


def port_of(parts: SplitResult) -> int:
    """Return the port of an address, 443 or 80 by its scheme if it names none."""
    return parts.port or (443 if parts.scheme in ("wss", "https") else 80)


def open_tunnel(proxy: Proxy, parts: SplitResult, timeout_s: float) -> socket.socket:
    """Return a TCP connection through *proxy* to the host of *parts*; this function blocks.

    Each step takes at most *timeout_s* seconds.

    Raises:
        DialError: The proxy refuses the tunnel, or cannot be reached.
    """
    connection = http.client.HTTPConnection(proxy.host, proxy.port, timeout=timeout_s)
    headers = {"Proxy-Authorization": proxy.authorization} if proxy.authorization else {}
    host = (parts.hostname or "").encode("idna").decode()
    connection.set_tunnel(_bracket_ipv6(host), port_of(parts), headers)
    try:
        connection.connect()
    except (OSError, http.client.HTTPException) as error:
        connection.close()
        raise _tunnel_error(proxy, parts, error) from error
    tunnel: socket.socket = connection.sock
    return tunnel


def _tunnel_error(proxy: Proxy, parts: SplitResult, error: Exception) -> DialError:
    """Return the error of a tunnel that was not opened.

    After an answer 4xx to CONNECT, the URL or the proxy has to change first (`DialError.is_wrong_address`).
    """
    names = f"the proxy {proxy.shown_url}, which {proxy.variable} names,"
    # http.client states the answer of the proxy only in the text of its error.
    answer = shorten(str(error).partition("Tunnel connection failed: ")[2])
    if not answer:
        is_unanswered = isinstance(error, OSError) and error.errno not in ANSWERED_ERRNOS
        hint = f"correct {proxy.variable}, or name {parts.hostname} in NO_PROXY"
        return DialError(
            ConnectError(f"{names} does not answer as a proxy", hint=hint), is_unanswered=is_unanswered
        )
    hint = f"ask who runs the proxy to allow CONNECT to it, or name {parts.hostname} in NO_PROXY"
    if answer.startswith("407"):
        hint = f"set {proxy.variable}=http://USER:PASSWORD@PROXY:PORT with the name of a user of the proxy"
    elif answer.startswith("5"):
        hint = "check host and port of the URL: the proxy does not reach it"
    address = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}"
    return DialError(
        ConnectError(f"{names} answers {answer} for {address}", hint=hint),
        is_wrong_address=answer.startswith("4"),
    )


def find_proxy(scheme: str, host: str, port: int) -> Proxy | None:
    """Return the proxy that the environment names for *host*; None for a direct connection.

    Hosts that are exempt by ``NO_PROXY`` and addresses of this machine (loopback) are reached directly.

    Raises:
        UsageError: The environment variable names no HTTP proxy.
    """
    proxies = urllib.request.getproxies()
    name = next((name for name in (WEB_SCHEME[scheme], "all") if proxies.get(name)), None)
    if name is None or is_loopback(host) or _is_exempt(host, port, proxies.get("no", "")):
        return None
    return _parse_proxy(proxies[name], f"{name.upper()}_PROXY")


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
