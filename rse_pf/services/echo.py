"""The service ``echo``: return the request, to measure the cost of the platform without a computation."""

from __future__ import annotations

from typing import Any

import msgspec

from rse_pf.service import Registry

__all__ = ["EchoReply", "EchoRequest", "register"]


class EchoRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Any value that a message can carry."""

    value: Any = None


class EchoReply(msgspec.Struct, frozen=True, kw_only=True):
    """The value of the request."""

    value: Any = None


def register(registry: Registry) -> None:
    """Add the service ``echo`` to *registry*."""

    @registry.service("echo", cheap=True)
    def echo(request: EchoRequest) -> EchoReply:
        """Return the value of the request."""
        return EchoReply(value=request.value)
