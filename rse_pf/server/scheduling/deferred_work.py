"""Do the work for unauthenticated clients in small steps, so that robots are served in between.

A step is a call that takes well under a millisecond.  The clock is an argument, and nothing here uses a
socket.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections import deque
from collections.abc import Callable
from typing import Any

__all__ = ["DeferredWork"]


class DeferredWork:
    """Steps that run oldest first, for a bounded time in each round of an event loop."""

    def __init__(self, loop: AbstractEventLoop, *, clock: Callable[[], float], bound_s: float) -> None:
        """Hold no step yet.

        Args:
            loop: Runs the steps.
            clock: Seconds, monotonic.
            bound_s: No further step begins in a round of *loop* after its steps have taken this long.
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
        """Call *step* with *arguments* behind the steps that wait, never before this returns."""
        self._steps.append((step, arguments))
        self._plan()

    def _plan(self) -> None:
        if self._steps and not self._is_planned:
            self._is_planned = True
            self._loop.call_soon(self._run)

    def _run(self) -> None:
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
