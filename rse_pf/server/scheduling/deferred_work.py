"""Do the work for unauthenticated clients in small steps, so that connected robots are served in between.

A step is a call of a function, such as one read of a handshake, that takes well under a millisecond.  In each
round of the event loop steps run until a limit of time, and the others wait for the next round.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections import deque
from collections.abc import Callable
from typing import Any

__all__ = ["DeferredWork"]


class DeferredWork:
    """A queue of steps, first in, first out, that run for a bounded time in each round of an event loop."""

    def __init__(self, loop: AbstractEventLoop, *, clock: Callable[[], float], bound_s: float) -> None:
        """Hold no step yet.

        Args:
            loop: The event loop in which the steps run.
            clock: Returns monotonic seconds.
            bound_s: Seconds after which no further step begins in the same round of *loop*.
        """
        self._loop = loop
        self._clock = clock
        self._bound_s = bound_s
        self._steps: deque[tuple[Callable[..., object], tuple[Any, ...]]] = deque()
        self._is_planned = False

    def __len__(self) -> int:
        """Return how many steps wait."""
        return len(self._steps)

    def add(self, step: Callable[..., object], *arguments: Any) -> None:
        """Call *step* with *arguments* after the steps that wait already, and never before `add` returns."""
        self._steps.append((step, arguments))
        self._plan()

    def _plan(self) -> None:
        if self._steps and not self._is_planned:
            self._is_planned = True
            self._loop.call_soon(self._run)

    def _run(self) -> None:
        """Run waiting steps until the time of this round is used, and plan the others for the next round."""
        steps, until = self._steps, self._clock() + self._bound_s
        steps_left = len(steps)
        try:
            while steps_left:
                steps_left -= 1
                step, arguments = steps.popleft()
                step(*arguments)
                if self._clock() >= until:
                    break
        finally:
            # The event loop reports a step that raises, and the other steps run in the next round.
            self._is_planned = False
            self._plan()
