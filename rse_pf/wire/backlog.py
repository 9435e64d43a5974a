"""After an outage, send what waited so that something fresh is answered soon: few, and the newest first.

When a link heals, every robot has seconds of frames to send and the server gets them all at once.  Oldest
first, they reach their turn when their time is over, and the fresh ones stand behind them.  So, once the
oldest has used up half of its time, frames go newest first and one at a time, one more with every answer
that found the server at leisure, until none of those that waited is left.  After a shorter outage, a server
that died, all can be in time: they go as they came.  Commands without a stream are no frames: they keep their
order and their room.  Promises to know no clock, and that a robot is never left without room.

Source:
    Maurer 2015, "Fail at Scale", ACM Queue 13(8): adaptive LIFO; Jacobson 1988: slow start.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Backlog", "is_long", "turn"]

_LEISURE_MS = 50.0
"""A server in whose queue a command waited longer has enough to do; the default of its `queue_target_ms`."""


_LONG = 0.5
"""An outage that took more of a frame's time than this was a long one."""


@dataclass(slots=True, kw_only=True)
class Backlog:
    """How many frames may be on their way on a link that came after an outage."""

    newest: int
    """The last of those that waited for the link."""
    room: int = 1

    def heard(self, queue_ms: float) -> None:
        """Let one more go if the server was at leisure, or begin again with one."""
        self.room = self.room + 1 if queue_ms <= _LEISURE_MS else 1


def is_long(submitted_s: float, deadline_s: float, now_s: float) -> bool:
    """Whether an outage that ends now took so much of a frame's time that it may have no turn in the rest."""
    return now_s - submitted_s > _LONG * (deadline_s - submitted_s)


def turn(identity: int, stream: str) -> tuple[bool, int]:
    """Return the key that sorts what waits: what has no stream as it came, then the newest frame."""
    return (True, -identity) if stream else (False, identity)
