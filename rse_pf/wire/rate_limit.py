"""The rate limiter of a robot: a token bucket a little smaller than the one that the server applies.

A robot that keeps to its own rate limiter is not refused by the server for its rate.
"""

from __future__ import annotations

from rse_pf.token_bucket import TokenBucket
from rse_pf.wire.messages import Limits

__all__ = ["RateLimiter"]

# Share of the server's limit that a robot uses: a network may deliver messages closer together than sent.
_OWN_SHARE = 0.9
_UNLIMITED = 1 << 30


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
