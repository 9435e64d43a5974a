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
from rse_pf.backend.live_map.owner.work.whole_fit import WholeFit
from rse_pf.backend.log import JsonLog
from rse_pf.live_map.events import Event
from rse_pf.live_map.measure import joined_links

__all__ = ["Measuring", "candidates_of"]

_AT_ONCE = 2
"""Threads that measure: both share one keyframe, or take one each where more wait."""
_FEW_WAIT, _FEWER, _FEWEST = 4, 6, 4
"""Where more keyframes wait than the first number, a keyframe is compared with so many others; where twice as
many wait, with the last number."""


def candidates_of(waiting: int) -> int | None:
    """Return with how many others a keyframe is compared while *waiting* others wait; None for all.

    What is found enters the log, so a replay does not depend on it.
    """
    if waiting <= _FEW_WAIT:
        return None
    return _FEWER if waiting <= 2 * _FEW_WAIT else _FEWEST


class Measuring:
    """Measures one keyframe or two at a time; its methods are called in the event loop."""

    def __init__(
        self,
        state: MapState,
        threads: Threads,
        submit: Callable[[Event], Any],
        *,
        fit: WholeFit,
        json_log: JsonLog,
        name: str,
    ) -> None:
        """Begin with what the last owner has left, at `run`.

        Args:
            state: The map.
            threads: In which to look.
            submit: Lets an event enter the log.
            fit: Fits the whole graph.
            json_log: Of the server.
            name: Of the map.
        """
        self._state, self._threads, self._submit = state, threads, submit
        self._fit, self._json_log, self._name = fit, json_log, name
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
        await asyncio.gather(*(self._work() for _ in range(_AT_ONCE)))

    async def _work(self) -> None:
        while True:
            await self._wake.wait()
            if self._waiting:
                await self._measure(self._waiting.popleft())
            elif self._optimise_wanted:
                self._optimise_wanted = False
                await self._optimise()
            else:
                self._wake.clear()

    async def _measure(self, keyframe: int) -> None:
        threads, waiting = self._threads, len(self._waiting)
        look = functools.partial(
            self._state.measuring, keyframe, 1 if waiting else _AT_ONCE, candidates_of(waiting)
        )
        pieces = await threads.compute(Urgency.MEASURE, look)
        begun = [threads.look(measure) for measure in pieces]
        self._submit(joined_links(keyframe, [await each for each in begun]))
        self._has_measured = True

    async def _optimise(self) -> None:
        begin = functools.partial(self._state.optimising, self._fit)
        fit = await self._threads.compute(Urgency.BACKGROUND, begin)
        optimised = await self._threads.look(fit)
        if optimised is None:
            self._json_log.warning("live-optimisation-failed", map=self._name)
        else:
            self._submit(optimised)
