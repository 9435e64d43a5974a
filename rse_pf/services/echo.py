"""The echo service: measures the cost of the platform, without any computation."""

from __future__ import annotations

from typing import Any

import msgspec

from rse_pf.service import Registry

__all__ = ["EchoReply", "EchoRequest", "register"]


class EchoRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Anything that travels in a message."""

    value: Any = None


class EchoReply(msgspec.Struct, frozen=True, kw_only=True):
    """The same value."""

    value: Any = None


def register(registry: Registry) -> None:
    """Add ``echo`` to *registry*."""

    @registry.service("echo", cheap=True)
    def echo(request: EchoRequest) -> EchoReply:
        """Return what was sent."""
        return EchoReply(value=request.value)
