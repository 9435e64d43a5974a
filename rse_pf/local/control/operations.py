"""Operations that an operator requests of a control plane: drain, move robots, replace all servers (roll).

An operation continues after the command that requested it has exited.  Only one runs at a time: two
operations would drain each other's servers.
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
# Name of the last event that the requester of an operation gets if it succeeded.
OVER = "operation-over"
# Name of the last event that the requester of an operation gets if it failed.
FAILED = "operation-failed"
# Connections that may watch at the same time: a few pages and commands of one operator.
_MAX_WATCHERS = 8
# Events that are kept for a connection that reads slowly; newer ones are dropped, and gaps in the field
# ``number`` show it.
_MAX_WAITING_EVENTS = 1000
# Time between two states of the platform that a watching connection gets, in seconds.
_STATE_PERIOD_S = 1.0
# A state is sent this long after a full second of the monotonic clock, in seconds: at the full second the
# monitor begins its sample, which the state should hold.
_STATE_DELAY_S = 0.15
# If a state still holds the sample of the state before it, the next state follows at once, after
# `_MIN_STATE_PERIOD_S`; at most this many times in a row.
_MAX_LATE = 5
# Shortest time between two states, in seconds, and the longest time from an event to the next state.
_MIN_STATE_PERIOD_S = 0.1


class Operations:
    """The operations of one platform, and the connections that receive its events."""

    def __init__(self, keep: Callable[[Coroutine[Any, Any, None]], None]) -> None:
        """Run nothing yet; *keep* runs a coroutine until it is done or the platform stops."""
        self._keep = keep
        self._listeners: set[Callable[[Event], None]] = set()
        self._running = ""
        self._watchers = 0

    def take_event(self, event: Event) -> None:
        """Pass an event of the platform on to the requester of an operation, and to all who watch."""
        for listener in list(self._listeners):
            listener(event)

    def begin(self, name: str, work: Callable[[], Coroutine[Any, Any, Any]]) -> AsyncGenerator[Event, None]:
        """Run *work* in the background as the operation *name*, and return the events meanwhile.

        The generator yields every event of the platform, and last `OVER`, or `FAILED` with message and hint.
        The operation goes on if nobody reads it.

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
        """Return a generator of what *state* returns, about once a second, and of each event at once.

        It has no end.  A state is yielded as ``{"state": {...}}``; an event has the further fields ``time_s``
        (Unix time) and ``number`` (counted from 1 for this connection).

        Raises:
            UsageError: `_MAX_WATCHERS` connections watch already.
        """
        if self._watchers >= _MAX_WATCHERS:
            raise UsageError(
                f"{_MAX_WATCHERS} connections receive the platform's events already",
                hint="close a fleet page, or a command that follows events",
            )
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
        """Run *work*, and put `OVER` or `FAILED` into *events* when it is done, fails or is cancelled."""
        last: Event = {"event": FAILED, "message": "the platform is being stopped", "hint": ""}
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
