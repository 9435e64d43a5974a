"""The updates of one topic, as `Robot.subscribe` gives them: the newest value of each key, and no queue.

What arrives while nobody asks replaces what waits under the same key.  The subscription survives reconnects
and moves; the server then sends the present state again.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from types import TracebackType
from typing import Any

from client_sdk.auto_close import Closing
from rse_pf.errors import Disconnected, RsePfError, error_from_code
from rse_pf.wire.client_session import ClientSession
from rse_pf.wire.client_subscriptions import SubscriptionEnded, Updated

__all__ = ["BlockingUpdates", "RobotSubscriptions", "Updates"]

_MAX_KEYS = 4096
"""Values that wait; the key that waited longest is given up first."""


class Updates:
    """An async iterator of keys and their values; it ends when it is closed.

    ``async with robot.subscribe(topic) as updates`` closes it at the end of the block; an ``async for`` over
    it closes it when the loop ends.
    """

    def __init__(self, topic: str, on_close: Callable[[], None]) -> None:
        """Wait for values.

        Args:
            topic: What the updates are about.
            on_close: Called once, when nobody wants more of them.
        """
        self.topic = topic
        self.replaced = 0
        """How many values newer ones replaced before they were read."""
        self._on_close = on_close
        self._newest: dict[str, Any] = {}
        self._changed = asyncio.Event()
        self._error: RsePfError | None = None
        self._is_closed = False

    async def next(self) -> tuple[str, Any]:
        """Return a key and its newest value; the key that waited longest comes first.

        Raises:
            StopAsyncIteration: The updates were closed.
            RsePfError: The server refused or ended the subscription, or the robot was closed.
        """
        while not self._newest:
            if self._is_closed:
                raise StopAsyncIteration
            if self._error is not None:
                raise self._error
            self._changed.clear()
            await self._changed.wait()
        key = next(iter(self._newest))
        return key, self._newest.pop(key)

    def take(self, key: str, value: Any) -> None:
        """Take the newest value of *key*."""
        self.replaced += key in self._newest
        self._newest[key] = value
        if len(self._newest) > _MAX_KEYS:
            del self._newest[next(iter(self._newest))]
        self._changed.set()

    def end(self, error: RsePfError) -> None:
        """Raise *error* once what waits was read."""
        self._error = error
        self._changed.set()

    def close(self) -> None:
        """End the subscription; does nothing a second time."""
        if not self._is_closed:
            self._is_closed = True
            self._newest.clear()
            self._changed.set()
            self._on_close()

    async def __aiter__(self) -> AsyncIterator[tuple[str, Any]]:
        """Yield what `next` returns."""
        try:
            while True:
                try:
                    update = await self.next()
                except StopAsyncIteration:
                    return
                yield update
        finally:
            self.close()

    async def __aenter__(self) -> Updates:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End the subscription."""
        self.close()


class RobotSubscriptions:
    """The updates that a robot has open, by the ids of their subscriptions."""

    def __init__(self, session: ClientSession, flush: Callable[[], None], clock: Callable[[], float]) -> None:
        """Begin with none.

        Args:
            session: Of the robot.
            flush: Sends what the session has to send.
            clock: Seconds, monotonic.
        """
        self._session = session
        self._flush = flush
        self._clock = clock
        self._open: dict[int, Updates] = {}

    def begin(self, topic: str) -> Updates:
        """Return the updates of *topic*."""
        identity = self._session.subscribe(topic, self._clock())

        def close() -> None:
            self._open.pop(identity, None)
            self._session.unsubscribe(identity, self._clock())
            self._flush()

        updates = self._open[identity] = Updates(topic, close)
        self._flush()
        return updates

    def take(self, event: Updated | SubscriptionEnded) -> None:
        """Pass an event of the session on to whom it concerns."""
        if isinstance(event, Updated):
            updates = self._open.get(event.id)
            if updates is not None:
                updates.take(event.key, event.payload)
            return
        ended = self._open.pop(event.id, None)
        if ended is not None:
            why = event.failure
            ended.end(
                error_from_code(why.code, why.message, hint=why.hint, retry_after_ms=why.retry_after_ms)
            )


class BlockingUpdates(Closing):
    """`Updates` for programs without asyncio; it waits for each value."""

    def __init__(self, updates: Updates, wait: Callable[[Coroutine[Any, Any, Any]], Any]) -> None:
        """Iterate over *updates*; *wait* runs a coroutine in their event loop and returns its result."""
        self._updates = updates
        self._wait = wait

    def __iter__(self) -> Iterator[tuple[str, Any]]:
        """Yield keys and their newest values until the updates are closed."""
        while True:
            update = self._wait(self._next())
            if update is None:
                return
            yield update

    def close(self) -> None:
        """End the subscription; the end of the robot ends it, too."""
        with contextlib.suppress(Disconnected):
            self._wait(self._close())

    async def _next(self) -> tuple[str, Any] | None:
        try:
            return await self._updates.next()
        except StopAsyncIteration:
            return None

    async def _close(self) -> None:
        self._updates.close()
