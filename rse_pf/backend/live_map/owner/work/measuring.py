"""Look for the links of each keyframe after it was applied, and fit the whole graph when that is wanted.

What is found enters the log as events.  The map goes on meanwhile: its thread only hands out what is needed.
"""

from __future__ import annotations

import asyncio
import functools
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from rse_pf.backend.live_map.owner.state import MapState
from rse_pf.backend.live_map.owner.work.threads import Threads, Urgency
from rse_pf.backend.log import JsonLog
from rse_pf.live_map.events import Event
from rse_pf.live_map.measure import joined_links

__all__ = ["Measuring"]

_PIECES = 2
"""Threads that measure one keyframe."""


class Measuring:
    """Measures one keyframe at a time; its methods are called in the event loop."""

    def __init__(
        self,
        state: MapState,
        threads: Threads,
        submit: Callable[[Event], Any],
        *,
        json_log: JsonLog,
        name: str,
    ) -> None:
        """Begin with what the last owner has left, at `run`.

        Args:
            state: The map.
            threads: In which to look.
            submit: Lets an event enter the log.
            json_log: Of the server.
            name: Of the map.
        """
        self._state, self._threads, self._submit = state, threads, submit
        self._json_log, self._name = json_log, name
        self._waiting = deque(state.unmeasured)
        self._wake = asyncio.Event()
        self._wake.set()
        self._optimise_wanted = False
        self._has_measured = False

    @property
    def is_proven(self) -> bool:
        """Whether a keyframe has gone the whole way, and none is left that may end the process."""
        return self._has_measured and not self._state.unmeasured

    def measure(self, keyframes: Iterable[int]) -> None:
        """Measure these keyframes, too."""
        self._waiting.extend(keyframes)
        self._wake.set()

    def optimise(self) -> None:
        """Fit the whole graph when no keyframe waits."""
        self._optimise_wanted = True
        self._wake.set()

    async def run(self) -> None:
        """Work until cancelled."""
        threads, state = self._threads, self._state
        while True:
            await self._wake.wait()
            if self._waiting:
                keyframe = self._waiting.popleft()
                pieces = await threads.compute(
                    Urgency.MEASURE, functools.partial(state.measuring, keyframe, _PIECES)
                )
                begun = [threads.look(measure) for measure in pieces]
                self._submit(joined_links(keyframe, [await each for each in begun]))
                self._has_measured = True
            elif self._optimise_wanted:
                self._optimise_wanted = False
                fit = await threads.compute(Urgency.BACKGROUND, state.optimising)
                optimised = await threads.look(fit)
                if optimised is None:
                    self._json_log.warning("live-optimisation-failed", map=self._name)
                else:
                    self._submit(optimised)
            else:
                self._wake.clear()
