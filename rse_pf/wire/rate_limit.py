"""How fast a robot sends: by the server's limits, and in which order and at which rate after an outage.

A robot that keeps to its own rate limiter, a token bucket a little smaller than the one that the server
applies, is not refused for its rate.

When a network recovers, every robot has the frames of some seconds to send, and the server receives all of
them at once.  If the oldest were sent first, each frame would reach the front of the server's queue only
after its deadline, and fresh frames would wait behind it.  After a long outage (`is_long_outage`) frames are
therefore sent newest first and one at a time; each answer from a server whose queue is short allows one more
frame in flight.  After a short outage, such as the loss of a server, every frame can still meet its deadline,
and frames are sent oldest first.  Commands without a stream are no frames; they are always sent oldest first.

Source:
    Maurer 2015, "Fail at Scale", ACM Queue 13(8): adaptive LIFO; Jacobson 1988: slow start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.wire.messages import Limits

__all__ = [
    "MAX_PAUSE_S",
    "REASONS",
    "Backlog",
    "RateLimiter",
    "Reason",
    "command_burst",
    "is_long_outage",
    "send_order",
]

Reason = Literal["busy", "own-limit"]
"""Why a command was held back: by a busy answer, or by the limits of the Welcome."""

REASONS: tuple[Reason, ...] = get_args(Reason)
"""All values of `Reason`."""

MAX_PAUSE_S = 60.0
"""Longest time in seconds for which the commands of a stream wait after one busy answer, whatever pause the
server asks for."""

# Fraction of the server's rate limit that a robot uses: a network may deliver messages closer together than
# they were sent.
_OWN_SHARE = 0.9
# Messages that may be sent at once where there is no limit.
_UNLIMITED = 1 << 30
# A robot may send as many messages at once as its rate limit allows in this time, in seconds: the frames that
# wait during one reconnection.
_BURST_S = 2.0
# Time in a server's queue, in milliseconds, up to which the queue counts as short.
_SHORT_QUEUE_MS = 50.0
# Fraction of the time from a frame's submission to its deadline; an outage that took more is long.
_LONG_OUTAGE_SHARE = 0.5


def command_burst(max_commands_per_s: float) -> int:
    """Return how many messages a robot with this rate limit may send at once; 0 without a rate limit."""
    return max(1, round(_BURST_S * max_commands_per_s)) if max_commands_per_s > 0 else 0


class RateLimiter:
    """Limits the messages that a robot sends on one connection to a rate a little below the server's limit.

    There is no limit without *limits*, or if ``max_commands_per_s`` is 0.
    """

    __slots__ = ("_bucket",)

    def __init__(self, limits: Limits | None = None) -> None:
        self._bucket: TokenBucket | None = None
        if limits is not None and limits.max_commands_per_s > 0:
            burst = max(1.0, _OWN_SHARE * limits.command_burst)
            self._bucket = TokenBucket(_OWN_SHARE * limits.max_commands_per_s, burst)

    def available(self, now: float) -> int:
        """Return how many messages may be sent at *now* (monotonic seconds)."""
        if self._bucket is None:
            return _UNLIMITED
        self._bucket.fill(now)
        return max(0, int(self._bucket.tokens))

    def spend(self, now: float) -> None:
        """Count one message that is sent at *now*, even if the limit would not allow it."""
        if self._bucket is not None:
            self._bucket.spend(1.0, now)

    def next_s(self, now: float) -> float:
        """Return the time (s) at which the next message may be sent: *now* if it may be sent at once."""
        return now if self._bucket is None else now + self._bucket.wait_s(now)


@dataclass(slots=True, kw_only=True)
class Backlog:
    """The number of frames that may be in flight on a connection that was opened after a long outage.

    ``newest`` is the id of the newest frame that waited for this connection: the limit holds until all frames
    up to it were sent or have ended.
    """

    newest: int
    max_in_flight: int = 1

    def note_answer(self, queue_ms: float) -> None:
        """Allow one more frame in flight if *queue_ms* shows a short queue; otherwise allow only one again.

        *queue_ms* is the time for which the command of an answer waited in the server's queue.
        """
        self.max_in_flight = self.max_in_flight + 1 if queue_ms <= _SHORT_QUEUE_MS else 1


def is_long_outage(submitted_s: float, deadline_s: float, now_s: float) -> bool:
    """Return whether an outage that ends at *now_s* took most of the time of the oldest waiting frame.

    This frame was submitted at *submitted_s* and has the deadline *deadline_s*.
    """
    return now_s - submitted_s > _LONG_OUTAGE_SHARE * (deadline_s - submitted_s)


def send_order(identity: int, stream: str) -> tuple[bool, int]:
    """Return the sort key of a command that waits after a long outage.

    Commands without a stream come first, the oldest first; then frames, the newest first.
    """
    return (True, -identity) if stream else (False, identity)
