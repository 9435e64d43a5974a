"""How fast a robot sends: by the server's limits, and in which order and at which rate after an outage.

A robot that keeps to its own rate limiter, a token bucket a little smaller than the one that the server
applies, is not refused for its rate.  A server with too much to do may tell it a lower rate for a while
(`rse_pf.wire.messages.Rate`): commands then keep a pause, which pings do not count towards.

When a network recovers, every robot has seconds of frames to send, and the server receives all of them at
once.  Sent oldest first, each frame would reach the front of the queue only when its deadline has passed, and
fresh frames would queue behind it.  After a long outage (`is_long_outage`) frames are therefore sent newest
first and one at a time; each answer from a server whose queue is short allows one more frame in flight.
After a short outage, such as the death of a server, every frame can still meet its deadline and the original
order is kept.  Commands without a stream are no frames: they are sent in their original order.

Source:
    Maurer 2015, "Fail at Scale", ACM Queue 13(8): adaptive LIFO; Jacobson 1988: slow start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from rse_pf.token_bucket import TokenBucket
from rse_pf.wire.messages import Limits, Rate

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

Reason = Literal["server-rate", "busy", "own-limit"]
"""Why a command was held back: by a told rate, by a busy answer, or by the limits of the Welcome."""

REASONS: tuple[Reason, ...] = get_args(Reason)

MAX_PAUSE_S = 60.0
"""For how long a robot believes one word of a server about its rate."""

# Share of the server's limit that a robot uses: a network may deliver messages closer together than sent.
_OWN_SHARE = 0.9
_UNLIMITED = 1 << 30
# The burst is what a robot sends in this time at its rate: the frames of one reconnect.
_BURST_S = 2.0
# A server is loaded if a command queued for longer; equals its ``QUEUE_TARGET_S``.
_SHORT_QUEUE_MS = 50.0
# An outage is long if it took more than this share of a frame's time.
_LONG_OUTAGE_SHARE = 0.5


def command_burst(max_commands_per_s: float) -> int:
    """Return how many messages a robot of this rate may send at once; 0 where there is no rate."""
    return max(1, round(_BURST_S * max_commands_per_s)) if max_commands_per_s > 0 else 0


class RateLimiter:
    """How fast a robot may send on one connection; unlimited without *limits* or without a rate in them."""

    __slots__ = ("_bucket", "_last_command_s", "_told_pause_s", "_told_until_s")

    def __init__(self, limits: Limits | None = None) -> None:
        self._bucket: TokenBucket | None = None
        self._last_command_s = self._told_until_s = -math.inf
        self._told_pause_s = 0.0
        if limits is not None and limits.max_commands_per_s > 0:
            burst = max(1.0, _OWN_SHARE * limits.command_burst)
            self._bucket = TokenBucket(_OWN_SHARE * limits.max_commands_per_s, burst)

    def available(self, now: float) -> int:
        """Return how many messages may be sent at *now* (s)."""
        if self._bucket is None:
            return _UNLIMITED
        self._bucket.fill(now)
        return max(0, int(self._bucket.tokens))

    def obey(self, rate: Rate, now: float) -> bool:
        """Keep to the rate that the server tells; return False if it makes no sense and is ignored."""
        if not (0.0 < rate.commands_per_s < math.inf and 0.0 <= rate.for_ms < math.inf):
            return False
        self._told_pause_s = 1.0 / rate.commands_per_s
        self._told_until_s = now + min(MAX_PAUSE_S, rate.for_ms / 1e3)
        return True

    def waits_for_told_rate(self, now: float) -> bool:
        """Return whether the rate that the server told allows no command at *now*."""
        return now < self._next_told_s()

    def spend(self, now: float, *, is_command: bool = False) -> None:
        """Count one message that is sent whatever the limit says."""
        if is_command:
            self._last_command_s = now
        if self._bucket is not None:
            self._bucket.spend(1.0, now)

    def next_s(self, now: float) -> float:
        """Return the time at which the next command may be sent, *now* if at once."""
        bucket_s = now if self._bucket is None else now + self._bucket.wait_s(now)
        return max(bucket_s, self._next_told_s())

    def _next_told_s(self) -> float:
        return min(self._told_until_s, self._last_command_s + self._told_pause_s)


@dataclass(slots=True, kw_only=True)
class Backlog:
    """How many frames may be in flight on a connection that was opened after a long outage.

    ``newest`` is the id of the last frame that waited for the connection.
    """

    newest: int
    max_in_flight: int = 1

    def note_answer(self, queue_ms: float) -> None:
        """Allow one more frame in flight if the server's queue is short; otherwise restart with one."""
        self.max_in_flight = self.max_in_flight + 1 if queue_ms <= _SHORT_QUEUE_MS else 1


def is_long_outage(submitted_s: float, deadline_s: float, now_s: float) -> bool:
    """Return whether an outage that ends now took most of the time that a frame had."""
    return now_s - submitted_s > _LONG_OUTAGE_SHARE * (deadline_s - submitted_s)


def send_order(identity: int, stream: str) -> tuple[bool, int]:
    """Return the sort key of a waiting command: without a stream oldest first, then frames newest first."""
    return (True, -identity) if stream else (False, identity)
