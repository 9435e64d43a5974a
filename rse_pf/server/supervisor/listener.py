"""Open the listening sockets of a server: for robots, and for the control port.

A server refuses to start if robots of other machines could connect without authentication.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable

from rse_pf.auth.tokens import KeySet
from rse_pf.config import PlatformSettings, ServingSettings
from rse_pf.config.placement import is_loopback
from rse_pf.errors import ConfigurationError
from rse_pf.http.control_port import ControlReply, ControlRequest, serve_control

__all__ = ["bound_socket", "check_authentication", "open_control"]


def check_authentication(settings: PlatformSettings, keys: KeySet | None, conformance_echo: bool) -> None:
    """Raise ConfigurationError if robots could connect without a token from other machines, or not at all.

    That is: no tokens are required, or messages are echoed (*conformance_echo*), and ``serving.host`` is no
    loopback address; or tokens are required, and *keys* is None.
    """
    host = settings.serving.host
    if conformance_echo and not is_loopback(host):
        raise ConfigurationError(
            f"conformance echo on {host} would let anybody connect", hint="set serving.host to 127.0.0.1"
        )
    if conformance_echo:
        return
    if settings.auth.required and keys is None:
        raise ConfigurationError(
            "robots need tokens, but there are no keys to check them with",
            hint="name a key set file, or set auth.required to false on a loopback address",
        )
    if not settings.auth.required and not is_loopback(host):
        raise ConfigurationError(
            f"auth.required = false on {host} would let anybody connect",
            hint="set auth.required to true, or serving.host to 127.0.0.1",
        )


def bound_socket(host: str, port: int) -> socket.socket:
    """Return a TCP socket that is bound to *host* and *port*, and does not listen yet.

    Raises:
        ConfigurationError: The address is not valid, or the port is taken.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setblocking(False)
            listener.bind(address)
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise _taken(host, port, error, "port") from error
    return listener


async def open_control(
    serving: ServingSettings, answer: Callable[[ControlRequest], Awaitable[ControlReply]]
) -> asyncio.Server:
    """Listen on the control port, and answer each request by the result of *answer*.

    Raises:
        ConfigurationError: The address is not valid, or the port is taken.
    """
    try:
        return await serve_control(serving.control_host, serving.control_port, answer)
    except OSError as error:
        raise _taken(serving.control_host, serving.control_port, error, "control_port") from error


def _taken(host: str, port: int, error: OSError, setting: str) -> ConfigurationError:
    return ConfigurationError(
        f"cannot listen on {host}:{port}: {error.strerror}", hint=f"choose another serving.{setting}, or 0"
    )
