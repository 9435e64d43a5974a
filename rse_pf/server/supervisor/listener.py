"""The listening sockets of a server, which no other machine reaches without authentication."""

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
    """Raise ConfigurationError if robots of other machines could connect without a token."""
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
    """Return a socket that is bound but does not listen yet; raises ConfigurationError."""
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
    """Listen on the control port and answer requests with *answer*; raises ConfigurationError."""
    try:
        return await serve_control(serving.control_host, serving.control_port, answer)
    except OSError as error:
        raise _taken(serving.control_host, serving.control_port, error, "control_port") from error


def _taken(host: str, port: int, error: OSError, setting: str) -> ConfigurationError:
    return ConfigurationError(
        f"cannot listen on {host}:{port}: {error.strerror}", hint=f"choose another serving.{setting}, or 0"
    )
