"""Deliver the updates of subscribed topics to a program: of each key only the newest value.

A value that arrives before the program has read an earlier value of its key replaces that value.  A
subscription survives reconnects and changes of the server; the new server sends the present values again.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from types import TracebackType
from typing import Any

from client_sdk.auto_close import AutoClose
from rse_pf.errors import Disconnected, RsePfError, error_from_code
from rse_pf.wire.client_session import ClientSession
from rse_pf.wire.client_subscriptions import SubscriptionEnded, Updated

__all__ = ["BlockingUpdates", "RobotSubscriptions", "Updates"]

MAX_UNREAD_KEYS = 4096
"""Most keys of one subscription whose values the program has not read yet; beyond it, the value that has
waited longest is dropped, and not counted in `Updates.replaced`."""


class Updates:
    """Iterate over the updates of one topic as pairs of key and value, until the subscription is closed.

    ``async with robot.subscribe(topic) as updates`` closes the subscription at the end of the block.  An
    ``async for`` over the updates closes the subscription, too, when the loop ends.
    """

    def __init__(self, topic: str, on_close: Callable[[], None]) -> None:
        """Begin without values to read.

        Args:
            topic: Name of the subscribed topic, such as ``live/MAP``.
            on_close: Called once when the program closes the subscription.
        """
        self.topic = topic
        self.replaced = 0
        """How many values were replaced by newer ones of their key before the program read them."""
        self._on_close = on_close
        self._unread: dict[str, Any] = {}
        self._changed = asyncio.Event()
        self._error: RsePfError | None = None
        self._is_closed = False

    async def next(self) -> tuple[str, Any]:
        """Wait for an update and return its key and newest value; the key that waited longest comes first.

        Raises:
            StopAsyncIteration: The program closed the subscription.
            RsePfError: The server refused or ended the subscription, or the robot was closed.
        """
        while not self._unread:
            if self._is_closed:
                raise StopAsyncIteration
            if self._error is not None:
                raise self._error
            self._changed.clear()
            await self._changed.wait()
        key = next(iter(self._unread))
        return key, self._unread.pop(key)

    def put(self, key: str, value: Any) -> None:
        """Store the newest value of *key* until the program reads it.

        Beyond `MAX_UNREAD_KEYS` the value that has waited longest is dropped.
        """
        self.replaced += key in self._unread
        self._unread[key] = value
        if len(self._unread) > MAX_UNREAD_KEYS:
            del self._unread[next(iter(self._unread))]
        self._changed.set()

    def fail(self, error: RsePfError) -> None:
        """Let `next` raise *error* after the program has read all values that wait."""
        self._error = error
        self._changed.set()

    def close(self) -> None:
        """End the subscription and drop unread values; do nothing if it was closed before."""
        if not self._is_closed:
            self._is_closed = True
            self._unread.clear()
            self._changed.set()
            self._on_close()

    async def __aiter__(self) -> AsyncIterator[tuple[str, Any]]:
        """Yield keys and their newest values, and close the subscription at the end of the loop."""
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
    """Hold the open subscriptions of one robot by their ids."""

    def __init__(self, session: ClientSession, flush: Callable[[], None], clock: Callable[[], float]) -> None:
        """Begin without open subscriptions.

        Args:
            session: Writes the messages that begin and end a subscription.
            flush: Sends the messages that the session has written.
            clock: Monotonic seconds.
        """
        self._session = session
        self._flush = flush
        self._clock = clock
        self._open: dict[int, Updates] = {}

    def subscribe(self, topic: str) -> Updates:
        """Send a subscription to *topic*, and return its updates."""
        identity = self._session.subscribe(topic, self._clock())

        def close() -> None:
            self._open.pop(identity, None)
            self._session.unsubscribe(identity, self._clock())
            self._flush()

        updates = self._open[identity] = Updates(topic, close)
        self._flush()
        return updates

    def handle_event(self, event: Updated | SubscriptionEnded) -> None:
        """Deliver an event of the session to the updates that it concerns, if they are still open."""
        if isinstance(event, Updated):
            updates = self._open.get(event.id)
            if updates is not None:
                updates.put(event.key, event.payload)
            return
        ended = self._open.pop(event.id, None)
        if ended is not None:
            failure = event.failure
            ended.fail(
                error_from_code(
                    failure.code, failure.message, hint=failure.hint, retry_after_ms=failure.retry_after_ms
                )
            )


class BlockingUpdates(AutoClose):
    """Iterate over the updates of one topic in a program without asyncio, as pairs of key and value.

    The end of a ``for`` loop does not close the subscription; `close` or the end of a ``with`` block does.
    """

    def __init__(self, updates: Updates, wait: Callable[[Coroutine[Any, Any, Any]], Any]) -> None:
        """Wrap *updates*; *wait* runs a coroutine in the event loop of their robot and returns its result."""
        self._updates = updates
        self._wait = wait

    def __iter__(self) -> Iterator[tuple[str, Any]]:
        """Yield keys and their newest values until the subscription is closed."""
        while True:
            update = self._wait(self._next())
            if update is None:
                return
            yield update

    def close(self) -> None:
        """End the subscription; do nothing if the robot is closed already."""
        with contextlib.suppress(Disconnected):
            self._wait(self._close())

    async def _next(self) -> tuple[str, Any] | None:
        try:
            return await self._updates.next()
        except StopAsyncIteration:
            return None

    async def _close(self) -> None:
        self._updates.close()
