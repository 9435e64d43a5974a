"""Keep to a rate: the bucket that a server measures a robot with, and the robot's own, a little smaller.

Promises no clock, and that a robot which keeps its pace is not refused for its rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rse_pf.wire.messages import Limits

__all__ = ["Bucket", "RateLimiter"]

_OWN_SHARE = 0.9
"""What a robot allows itself: a network may deliver in one moment what was sent over a longer one."""
_NO_LIMIT = 1 << 30


@dataclass(slots=True)
class Bucket:
    """A token bucket: *burst* at once, *rate* a second; starts full.

    Source:
        Turner 1986, "New directions in communications".
    """

    rate: float
    burst: float
    left: float = field(init=False)
    at: float = field(init=False, default=-math.inf)

    def __post_init__(self) -> None:
        """Fill it."""
        self.left = self.burst

    def take(self, now: float) -> float:
        """Take one token at *now* (s) and return 0, or the seconds until there is one again."""
        self.fill(now)
        if self.left >= 1.0:
            self.left -= 1.0
            return 0.0
        return (1.0 - self.left) / self.rate

    def is_full(self, now: float) -> bool:
        """Whether nothing was taken that time has not given back."""
        self.fill(now)
        return self.left >= self.burst

    def fill(self, now: float) -> None:
        """Add what the time until *now* gave."""
        if now > self.at:
            self.left = min(self.burst, self.left + (now - self.at) * self.rate)
            self.at = now


class RateLimiter:
    """How fast a robot may send on one link; without *limits*, or where they name no rate, at will."""

    __slots__ = ("_bucket",)

    def __init__(self, limits: Limits | None = None) -> None:
        self._bucket: Bucket | None = None
        if limits is not None and limits.max_commands_per_s > 0:
            burst = max(1.0, _OWN_SHARE * limits.command_burst)
            self._bucket = Bucket(_OWN_SHARE * limits.max_commands_per_s, burst)

    def room(self, now: float) -> int:
        """Return how many messages may go at *now* (s)."""
        if self._bucket is None:
            return _NO_LIMIT
        self._bucket.fill(now)
        return max(0, int(self._bucket.left))

    def spend(self, now: float) -> None:
        """Count one message, which goes in any case."""
        if self._bucket is not None:
            self._bucket.fill(now)
            self._bucket.left -= 1.0

    def next_s(self, now: float) -> float:
        """Return when the next message may go; *now* if at once."""
        if self._bucket is None or self.room(now):
            return now
        return now + (1.0 - self._bucket.left) / self._bucket.rate
