"""Operations of a control plane that an operator requests: drain a server, or replace all, one by one.

An operation continues when the command that requested it has ended.  Only one runs at a time: two would drain
each other's servers.
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
# Last event of an operation that succeeded.
OVER = "operation-over"
# Last event of an operation that failed.
FAILED = "operation-failed"
# Connections that may watch at the same time: a few pages and commands of one operator.
_MAX_WATCHERS = 8
# Events that wait for a slow watcher; newer ones are dropped, which their numbers show.
_MAX_WAITING_EVENTS = 1000
# Time between two states, in seconds.
_STATE_PERIOD_S = 1.0
# Delay of a state after the full second, in seconds, at which the monitor takes its sample.
_STATE_DELAY_S = 0.15
# A state is sent again at most this many times in a second while the sample of the monitor is late.
_MAX_LATE = 5
# Delay of a state after an event, in seconds, and the shortest time between two states.
_MIN_STATE_PERIOD_S = 0.1


class Operations:
    """The operations of one platform, and the events that they cause."""

    def __init__(self, keep: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        """Run nothing yet; *keep* lets work go on until it is done or the platform ends."""
        self._keep = keep
        self._listeners: set[Callable[[Event], None]] = set()
        self._running = ""
        self._watchers = 0

    def take_event(self, event: Event) -> None:
        """Pass an event of the platform on to the commands that wait for an operation."""
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
            UsageError: `_MAX_WATCHERS` connections watch already.
        """
        if self._watchers >= _MAX_WATCHERS:
            raise UsageError(f"{_MAX_WATCHERS} connections watch already", hint="end one of them")
        return self._yield_states_and_events(state)

    async def _yield_states_and_events(self, state: Callable[[], Event]) -> AsyncGenerator[Event, None]:
        loop = asyncio.get_running_loop()
        events: asyncio.Queue[Event] = asyncio.Queue(_MAX_WAITING_EVENTS)
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
                    past = math.floor((loop.time() - _STATE_DELAY_S) / _STATE_PERIOD_S)
                    due_s = (past + 1) * _STATE_PERIOD_S + _STATE_DELAY_S
                    if sample is not None and document.get("sample") == sample and late < _MAX_LATE:
                        late += 1
                        due_s = min(due_s, loop.time() + _MIN_STATE_PERIOD_S)
                    else:
                        sample, late = document.get("sample"), 0
                    yield {"state": document}
                    continue
                with contextlib.suppress(asyncio.TimeoutError):
                    yield await asyncio.wait_for(events.get(), max(left_s, 0.001))
                    due_s = min(due_s, loop.time() + _MIN_STATE_PERIOD_S)
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
