"""What a worker tells its supervisor of single robots, many events in one message.

Each message wakes the supervisor, which costs more than what it says.  Order is kept, and nothing is lost.
"""

from __future__ import annotations

from asyncio import AbstractEventLoop
from collections.abc import Callable
from typing import Any

__all__ = ["RobotEvents"]

_GATHER_S = 0.01
_MAX_EVENTS = 500
"""In one message; a line of the channel may have 1 MiB."""


class RobotEvents:
    """The events of one worker's robots; each waits at most 10 ms for others."""

    def __init__(self, loop: AbstractEventLoop, say: Callable[..., None]) -> None:
        """Hold no event yet; *say* sends a message to the supervisor."""
        self._loop = loop
        self._say = say
        self._held: list[dict[str, Any]] = []

    def add(self, **event: Any) -> None:
        """Send *event* together with those that follow within 10 ms."""
        if not self._held:
            self._loop.call_later(_GATHER_S, self.flush)
        self._held.append(event)

    def flush(self) -> None:
        """Send what is held, now."""
        held, self._held = self._held, []
        for first in range(0, len(held), _MAX_EVENTS):
            self._say(event="robots", robots=held[first : first + _MAX_EVENTS])
