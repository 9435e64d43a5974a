"""One address of a robot and the socket that is kept there; `connection` opens and reads it."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from typing import Any

from websockets.asyncio.client import ClientConnection

from client_sdk.network.backoff import Backoff
from client_sdk.network.dial_errors import DialError, hide_password
from rse_pf.wire.client_session import ConnectionState

__all__ = ["Region", "RegionSocket", "cancel_all", "either"]


class Region:
    """One address, and the socket that is kept there: the current one, or one that stands by."""

    def __init__(self, number: int, url: str, backoff: Backoff) -> None:
        self.number = number
        self.url = url
        self.address = hide_password(url) if url else ""
        self.backoff = backoff
        self.socket: RegionSocket | None = None
        self.since = 0.0
        self.joining: asyncio.Task[DialError | None] | None = None
        self.move_request: tuple[RegionSocket, float] | None = None
        self.is_double = False
        self.failed: DialError | None = None
        """Why the last attempt failed, or the server ended the socket; None if it may be tried at once."""
        self.changed = asyncio.Event()

    @property
    def usable(self) -> RegionSocket | None:
        """The socket, if commands may be sent on it from now on."""
        socket = self.socket
        is_leaving = socket is None or socket.state.leaving or socket.is_closing or socket.ended.is_set()
        return None if is_leaving else socket


class RegionSocket:
    """One WebSocket with its state in the session and its two tasks."""

    def __init__(self, region: Region, websocket: ClientConnection, state: ConnectionState) -> None:
        self.region = region
        self.websocket = websocket
        self.state = state
        self.measured = asyncio.Event()
        self.exchange: object = None
        self.welcome: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.ended = asyncio.Event()
        self.dirty = asyncio.Event()
        self.tasks: list[asyncio.Task[None]] = []
        self.is_closing = False
        self.bad_messages = self.recorded = 0


async def cancel_all(tasks: Iterable[asyncio.Task[Any]]) -> None:
    """Cancel *tasks* and wait until all have ended."""
    ending = list(tasks)
    for task in ending:
        task.cancel()
    await asyncio.gather(*ending, return_exceptions=True)


async def either(event: asyncio.Event, timeout_s: float) -> None:
    """Wait for *event*, at most *timeout_s*; unlike ``wait_for``, never swallow a cancellation."""
    waiting = asyncio.ensure_future(event.wait())
    try:
        await asyncio.wait({waiting}, timeout=timeout_s)
    finally:
        waiting.cancel()
