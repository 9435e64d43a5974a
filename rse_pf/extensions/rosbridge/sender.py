"""Send one client the messages of its topics, as fast as it reads them and as often as it asked for.

While the client has to wait, the newest messages of each subscription wait with it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Protocol

from rse_pf.extensions.rosbridge.pacing import Pacing
from rse_pf.extensions.rosbridge.subscription import Subscription, TopicMessage

__all__ = ["TopicSender"]


class Ping(Protocol):
    """Sends a WebSocket ping; what it returns is done with the pong, or fails with the connection."""

    async def __call__(self) -> Awaitable[float]:
        """Send it."""


class TopicSender:
    """The messages that wait for one client."""

    def __init__(
        self, *, write: Callable[[bytes], Awaitable[None]], ping: Ping, clock: Callable[[], float]
    ) -> None:
        """Send nothing yet; `run` does.

        Args:
            write: Sends a WebSocket message.
            ping: Sends a WebSocket ping.
            clock: Seconds, monotonic.
        """
        self._write, self._ping, self._clock = write, ping, clock
        self._pacing = Pacing()
        self._due: dict[Subscription, None] = {}
        self._wake = asyncio.Event()
        self._pong: asyncio.Task[None] | None = None

    def put(self, subscription: Subscription, message: TopicMessage) -> None:
        """Let *message* be sent, or wait in its *subscription* while the client has to wait."""
        subscription.put(message)
        if self._pacing.is_slow or subscription.wait_s(self._clock()) > 0:
            subscription.drop_surplus()
        self._due[subscription] = None
        self._wake.set()

    async def run(self) -> None:
        """Send until cancelled, or until the connection has ended, with the error of *write* or *ping*."""
        try:
            while True:
                await self._next_due()
                await self._pace()
                subscription = await self._next_due()  # the pong may have taken longer than a subscription
                del self._due[subscription]
                message = subscription.take(self._clock())
                if subscription:
                    self._due[subscription] = None  # behind the others
                await self._write(message)
                if self._pacing.is_free and self._pong is None:
                    self._pong = asyncio.ensure_future(self._measure())
        finally:
            if self._pong is not None:
                self._pong.cancel()
                await asyncio.gather(self._pong, return_exceptions=True)

    async def _next_due(self) -> Subscription:
        """Wait until a subscription has a message that may be sent now, and return the first one."""
        while True:
            self._wake.clear()
            now, wait_s = self._clock(), float("inf")
            for subscription in list(self._due):
                if not subscription:
                    del self._due[subscription]
                    continue
                left_s = subscription.wait_s(now)
                if left_s <= 0:
                    return subscription
                subscription.drop_surplus()
                wait_s = min(wait_s, left_s)
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._wake.wait(), None if wait_s == float("inf") else wait_s)

    async def _pace(self) -> None:
        """Wait until the client may be sent the next message."""
        if self._pong is not None and self._pacing.is_slow:
            await self._pong
        if not self._pacing.is_free:
            await asyncio.sleep(self._pacing.wait_s(self._clock()))
            await self._measure()

    async def _measure(self) -> None:
        """Send a ping, and wait for its pong; while that is late, only the newest messages wait."""
        began = self._clock()
        pong = asyncio.ensure_future(await self._ping())
        done, _ = await asyncio.wait({pong}, timeout=self._pacing.late_s)
        if not done:
            self._pacing.note_late()
            for subscription in self._due:
                subscription.drop_surplus()
        await pong
        now = self._clock()
        self._pacing.note_pong(now - began, now)
        self._pong = None
