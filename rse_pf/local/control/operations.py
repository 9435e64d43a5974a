"""What an operator may ask of a running control plane: drain one server, or replace all, one by one.

An operation goes on when the command that asked for it is gone.  Only one runs at a time: two would take
servers from each other.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from typing import Any

from rse_pf.errors import RsePfError, UsageError

__all__ = ["FAILED", "OVER", "Operations"]

Event = Mapping[str, Any]
OVER, FAILED = "operation-over", "operation-failed"
"""The last event of an operation."""


class Operations:
    """The operations of one platform, and the events that they cause."""

    def __init__(self, keep: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        """Run nothing yet; *keep* lets work go on until it is done or the platform ends."""
        self._keep = keep
        self._listeners: set[Callable[[Event], None]] = set()
        self._running = ""

    def heard(self, event: Event) -> None:
        """Take an event of the platform, and pass it on to the commands that wait for an operation."""
        for listener in list(self._listeners):
            listener(event)

    def begin(self, name: str, work: Callable[[], Coroutine[Any, Any, Any]]) -> AsyncIterator[Event]:
        """Start *work*, and return the events of the platform until it ended, and how that was.

        Raises:
            UsageError: Another operation is under way.
        """
        if self._running:
            raise UsageError(
                f"the operation {self._running!r} is under way", hint="wait for its end: rse-pf local status"
            )
        self._running = name
        events: asyncio.Queue[Event] = asyncio.Queue()
        self._listeners.add(events.put_nowait)
        self._keep(self._run(work, events))
        return self._until_over(events)

    async def _run(self, work: Callable[[], Coroutine[Any, Any, Any]], events: asyncio.Queue[Event]) -> None:
        last: Event = {"event": FAILED, "message": "the platform ends", "hint": ""}
        try:
            await work()
            last = {"event": OVER}
        except RsePfError as error:
            last = {"event": FAILED, "message": error.message, "hint": error.hint}
        finally:
            self._running = ""
            events.put_nowait(last)

    async def _until_over(self, events: asyncio.Queue[Event]) -> AsyncIterator[Event]:
        try:
            while True:
                event = await events.get()
                yield event
                if event["event"] in (OVER, FAILED):
                    return
        finally:
            self._listeners.discard(events.put_nowait)
