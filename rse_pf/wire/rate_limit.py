"""Token buckets: the one by which a server measures a robot, and the robot's own, a little smaller.

A robot that keeps to its own rate limiter is not refused by the server for its rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from rse_pf.wire.messages import Limits

__all__ = ["RateLimiter", "TokenBucket"]

_OWN_SHARE = 0.9
"""Share of the server's limit that a robot uses: a network may deliver messages closer together than sent."""
_UNLIMITED = 1 << 30


@dataclass(slots=True)
class TokenBucket:
    """A bucket of *burst* tokens, refilled with *rate* tokens a second; it starts full.

    Source:
        Turner 1986, "New directions in communications".
    """

    rate: float
    burst: float
    left: float = field(init=False)
    at: float = field(init=False, default=-math.inf)

    def __post_init__(self) -> None:
        """Fill the bucket."""
        self.left = self.burst

    def take(self, now: float) -> float:
        """Take one token at *now* (s) and return 0, or return the seconds until one is available."""
        wait_s = self.wait_s(now)
        if not wait_s:
            self.left -= 1.0
        return wait_s

    def wait_s(self, now: float) -> float:
        """Return the seconds until one token is available, 0 if one is available at *now*."""
        self.fill(now)
        return 0.0 if self.left >= 1.0 else (1.0 - self.left) / self.rate

    def spend(self, tokens: float, now: float) -> float:
        """Take *tokens*, more than there are if need be; return the seconds until earlier debt is repaid."""
        self.fill(now)
        wait_s = max(0.0, -self.left) / self.rate
        self.left -= tokens
        return wait_s

    def is_full(self, now: float) -> bool:
        """Return whether all tokens that were taken have been refilled."""
        self.fill(now)
        return self.left >= self.burst

    def fill(self, now: float) -> None:
        """Add the tokens of the time until *now*."""
        if now > self.at:
            self.left = min(self.burst, self.left + (now - self.at) * self.rate)
            self.at = now


class RateLimiter:
    """How fast a robot may send on one connection; unlimited without *limits* or without a rate in them."""

    __slots__ = ("_bucket",)

    def __init__(self, limits: Limits | None = None) -> None:
        self._bucket: TokenBucket | None = None
        if limits is not None and limits.max_commands_per_s > 0:
            burst = max(1.0, _OWN_SHARE * limits.command_burst)
            self._bucket = TokenBucket(_OWN_SHARE * limits.max_commands_per_s, burst)

    def available(self, now: float) -> int:
        """Return how many messages may be sent at *now* (s)."""
        if self._bucket is None:
            return _UNLIMITED
        self._bucket.fill(now)
        return max(0, int(self._bucket.left))

    def spend(self, now: float) -> None:
        """Count one message that is sent whatever the limit says."""
        if self._bucket is not None:
            self._bucket.spend(1.0, now)

    def next_s(self, now: float) -> float:
        """Return the time at which the next message may be sent, *now* if at once."""
        return now if self._bucket is None else now + self._bucket.wait_s(now)
