"""uvicorn's HTTP/1.1 protocol with bounds on connections that send no request, and on idle ones.

uvicorn waits for ever for the end of a request's head, and counts connections that sent none against those
that did.  Here both kinds are cut when there are too many, the oldest first, and never one in a request.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from rse_pf.errors import MissingExtra
from rse_pf.silent_connections import FIRST_REQUEST_S, KEEP_ALIVE_S, MAX_SILENT, SilentConnections

__all__ = ["bounded_protocol"]


def bounded_protocol(
    *, seconds: float = FIRST_REQUEST_S, idle_s: float = KEEP_ALIVE_S, most: int = MAX_SILENT, most_idle: int
) -> type[asyncio.Protocol]:
    """Return uvicorn's protocol with keep-alive, with bounds, and without pipelining.

    Load balancers and our own clients wait for a response before the next request.  Bytes that follow a
    request earlier than that are never taken for a request: they may be an attempt to make two readers
    disagree about where a request ends (request smuggling).  The request is answered, then the connection is
    closed.

    Args:
        seconds: Time for the head of a request, from the connection or from the head's first byte.
        idle_s: Time between an answer and the next request.
        most: Connections that have sent no whole head; above that the oldest is cut.
        most_idle: Connections that were answered and wait; above that the one that waited longest is cut.

    Raises:
        MissingExtra: uvicorn is not installed.
    """
    try:
        from uvicorn.protocols.http.h11_impl import H11Protocol
    except ImportError as error:
        raise MissingExtra("uvicorn", "data") from error
    silent = _InLoop(seconds, most)
    idle = _InLoop(idle_s, most_idle)

    class BoundedProtocol(H11Protocol):
        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            silent.of(self.loop).enter(self, transport.abort)

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            self._unset_keepalive_if_required()  # uvicorn leaves it if the connection was reset
            silent.of(self.loop).leave(self)
            idle.of(self.loop).leave(self)

        def handle_events(self) -> None:
            super().handle_events()
            if self.cycle is not None and not self.cycle.response_complete:
                silent.of(self.loop).leave(self)
                idle.of(self.loop).leave(self)
            elif self.conn.trailing_data[0] and not self.transport.is_closing():
                idle.of(self.loop).leave(self)  # the next head has begun
                silent.of(self.loop).enter(self, self.transport.abort)

        def on_response_complete(self) -> None:
            if self.conn.trailing_data[0] and not self.transport.is_closing():
                self.transport.close()  # after what was written, so that the robot gets its response
            super().on_response_complete()
            self._unset_keepalive_if_required()
            if not self.transport.is_closing():
                idle.of(self.loop).enter(self, self.transport.close)

    return BoundedProtocol


class _InLoop:
    """`SilentConnections` of the loop in which uvicorn runs, which begins later."""

    def __init__(self, seconds: float, most: int) -> None:
        self._seconds = seconds
        self._most = most
        self._made: SilentConnections[object] | None = None

    def of(self, loop: asyncio.AbstractEventLoop) -> SilentConnections[object]:
        if self._made is None:
            later: Callable[..., asyncio.TimerHandle] = loop.call_later
            self._made = SilentConnections(call_later=later, seconds=self._seconds, most=self._most)
        return self._made
