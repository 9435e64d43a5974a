"""What an operator may ask of a running control plane: drain one server, or replace all, one by one.

An operation goes on when the command that asked for it is gone.  Only one runs at a time: two would take
servers from each other.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncGenerator, Callable, Coroutine, Mapping
from typing import Any

from rse_pf.errors import RsePfError, UsageError

__all__ = ["FAILED", "OVER", "Operations"]

Event = Mapping[str, Any]
OVER, FAILED = "operation-over", "operation-failed"
"""The last event of an operation."""
_MAX_WATCHERS = 8
_MAX_UNHEARD = 1000
"""Events that wait for a slow watcher; newer ones are left out then, and it can tell by their numbers."""
_LOOK_S, _AFTER_S = 1.0, 0.15
"""A state is told once a second, soon after the monitor took its sample at the full second."""
_MAX_LATE = 5
"""How often a second a state is told again because the monitor's sample is late."""
_SOONEST_S = 0.1
"""An event changes the state, which is then told this long after, and at most this often."""


class Operations:
    """The operations of one platform, and the events that they cause."""

    def __init__(self, keep: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        """Run nothing yet; *keep* lets work go on until it is done or the platform ends."""
        self._keep = keep
        self._listeners: set[Callable[[Event], None]] = set()
        self._running = ""
        self._watchers = 0

    def take_event(self, event: Event) -> None:
        """Take an event of the platform, and pass it on to the commands that wait for an operation."""
        for listener in list(self._listeners):
            listener(event)

    def begin(self, name: str, work: Callable[[], Coroutine[Any, Any, Any]]) -> AsyncGenerator[Event, None]:
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
        return self._yield_until_over(events)

    def watch(self, state: Callable[[], Event]) -> AsyncGenerator[Event, None]:
        """Return the *state* of the platform once a second, and each event at once, without an end.

        A state comes as ``{"state": {...}}``; an event has ``time_s``, Unix time, and ``number``.

        Raises:
            UsageError: `_MAX_WATCHERS` others watch.
        """
        if self._watchers >= _MAX_WATCHERS:
            raise UsageError(f"{_MAX_WATCHERS} others watch already", hint="end one of them")
        return self._yield_states_and_events(state)

    async def _yield_states_and_events(self, state: Callable[[], Event]) -> AsyncGenerator[Event, None]:
        loop = asyncio.get_running_loop()
        events: asyncio.Queue[Event] = asyncio.Queue(_MAX_UNHEARD)
        number = 0

        def take(event: Event) -> None:
            nonlocal number
            number += 1
            with contextlib.suppress(asyncio.QueueFull):
                events.put_nowait({**event, "time_s": round(time.time(), 3), "number": number})

        self._watchers += 1
        self._listeners.add(take)
        try:
            due_s = loop.time()
            sample: Any = None
            late = 0
            while True:
                left_s = due_s - loop.time()
                if left_s <= 0 and events.empty():
                    document = state()
                    due_s = (math.floor((loop.time() - _AFTER_S) / _LOOK_S) + 1) * _LOOK_S + _AFTER_S
                    if sample is not None and document.get("sample") == sample and late < _MAX_LATE:
                        late += 1
                        due_s = min(due_s, loop.time() + _SOONEST_S)
                    else:
                        sample, late = document.get("sample"), 0
                    yield {"state": document}
                    continue
                with contextlib.suppress(asyncio.TimeoutError):
                    yield await asyncio.wait_for(events.get(), max(left_s, 0.001))
                    due_s = min(due_s, loop.time() + _SOONEST_S)
        finally:
            self._watchers -= 1
            self._listeners.discard(take)

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

    async def _yield_until_over(self, events: asyncio.Queue[Event]) -> AsyncGenerator[Event, None]:
        try:
            while True:
                event = await events.get()
                yield event
                if event["event"] in (OVER, FAILED):
                    return
        finally:
            self._listeners.discard(events.put_nowait)
