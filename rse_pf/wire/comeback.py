"""After an outage, send what waited so that something fresh is answered soon: few, and the newest first.

When a link heals, every robot has seconds of frames to send and the server gets them all at once.  Oldest
first, they reach their turn when their time is over, and the fresh ones stand behind them.  So frames go
newest first and one at a time, one more with every answer that found the server at leisure, until none of
those that waited is left.  Commands without a stream are no frames: they keep their order and their room.
Promises to know no clock, and that a robot is never left without room.

Source:
    Maurer 2015, "Fail at Scale", ACM Queue 13(8): adaptive LIFO; Jacobson 1988: slow start.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Comeback", "turn"]


_LEISURE_MS = 50.0
"""A server in whose queue a command waited longer has enough to do; the default of its `queue_target_ms`."""


@dataclass(slots=True, kw_only=True)
class Comeback:
    """How many frames may be on their way on a link that came after an outage."""

    newest: int
    """The last of those that waited for the link."""
    room: int = 1

    def heard(self, queue_ms: float) -> None:
        """Let one more go if the server was at leisure, or begin again with one."""
        self.room = self.room + 1 if queue_ms <= _LEISURE_MS else 1


def turn(identity: int, stream: str) -> tuple[bool, int]:
    """Return the key that sorts what waits: what has no stream as it came, then the newest frame."""
    return (True, -identity) if stream else (False, identity)
