"""Send one client the messages of its topics, not faster than it reads, nor than its subscriptions ask for.

Messages that cannot be sent yet wait in the queues of the subscriptions, of which the oldest are dropped.
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
    """A function that sends a WebSocket ping."""

    async def __call__(self) -> Awaitable[float]:
        """Send a ping; return an awaitable that is done with the pong, or fails with the connection."""


class TopicSender:
    """Sends one client the messages that wait in its subscriptions."""

    def __init__(
        self, *, write: Callable[[bytes], Awaitable[None]], ping: Ping, clock: Callable[[], float]
    ) -> None:
        """Describe the client; `run` sends.

        Args:
            write: Sends a WebSocket message to the client.
            ping: Sends a WebSocket ping to the client.
            clock: Returns seconds, monotonic.
        """
        self._write, self._ping, self._clock = write, ping, clock
        self._pacing = Pacing()
        self._due: dict[Subscription, None] = {}
        self._wake = asyncio.Event()
        self._pong: asyncio.Task[None] | None = None

    def put(self, subscription: Subscription, message: TopicMessage) -> None:
        """Add *message* to the queue of *subscription*, from which `run` sends it.

        While nothing may be sent, messages above the requested queue length are dropped at once.
        """
        subscription.put(message)
        if self._pacing.is_slow or subscription.wait_s(self._clock()) > 0:
            subscription.drop_surplus()
        self._due[subscription] = None
        self._wake.set()

    async def run(self) -> None:
        """Send messages until cancelled.

        When the connection is lost, the error of *write* or *ping* is raised.
        """
        try:
            while True:
                await self._next_due()
                await self._pace()
                # Chosen again: the subscription that was chosen before the pong may have ended.
                subscription = await self._next_due()
                del self._due[subscription]
                message = subscription.take(self._clock())
                if subscription:
                    # The next message of this subscription is sent after those of other subscriptions.
                    self._due[subscription] = None
                await self._write(message)
                if self._pacing.is_free and self._pong is None:
                    self._pong = asyncio.ensure_future(self._measure())
        finally:
            if self._pong is not None:
                self._pong.cancel()
                await asyncio.gather(self._pong, return_exceptions=True)

    async def _next_due(self) -> Subscription:
        """Wait until a subscription has a message that may be sent now.

        Return the first such subscription.
        """
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
        """Wait until the next message may be sent to the client, as the pacing decides."""
        if self._pong is not None and self._pacing.is_slow:
            await self._pong
        if not self._pacing.is_free:
            await asyncio.sleep(self._pacing.wait_s(self._clock()))
            await self._measure()

    async def _measure(self) -> None:
        """Send a ping, wait for its pong, and record its delay.

        When the pong becomes late, messages above the requested queue lengths are dropped.
        """
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
