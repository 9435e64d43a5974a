"""Send events of single robots from a worker to its supervisor, several in one message.

To wake the supervisor costs more CPU time than to handle an event.  The order is kept, and nothing is lost.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable
from typing import Any

__all__ = ["RobotEvents"]

_GATHER_S = 0.01  # an event waits this long for others
_MAX_EVENTS = 500  # in one message, so that it stays below the 1 MiB that a line of the channel may have


class RobotEvents:
    """The events of the robots of one worker that wait to be sent."""

    def __init__(self, loop: AbstractEventLoop, say: Callable[..., None]) -> None:
        """Hold no event yet; *say* sends a message to the supervisor."""
        self._loop = loop
        self._say = say
        self._held: list[dict[str, Any]] = []

    def add(self, **event: Any) -> None:
        """Send *event* together with those that follow within `_GATHER_S`."""
        if not self._held:
            self._loop.call_later(_GATHER_S, self.flush)
        self._held.append(event)

    def flush(self) -> None:
        """Send the waiting events now."""
        held, self._held = self._held, []
        for first in range(0, len(held), _MAX_EVENTS):
            self._say(event="robots", robots=held[first : first + _MAX_EVENTS])
