"""The token bucket, which limits all rates: of commands, handshakes, recorded refusals and uploads."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

__all__ = ["TokenBucket"]


@dataclass(slots=True)
class TokenBucket:
    """A bucket of at most *burst* tokens, refilled with *rate* tokens a second; it is full at the start.

    ``tokens`` is the number at the time ``at`` of the last refill; it is negative after `spend` took more
    tokens than there were.  Times are seconds of one clock.

    Source:
        Turner 1986, "New directions in communications".
    """

    rate: float
    burst: float
    tokens: float = field(init=False)
    at: float = field(init=False, default=-math.inf)

    def __post_init__(self) -> None:
        """Fill the new bucket."""
        self.tokens = self.burst

    def take(self, now: float) -> float:
        """Take one token at *now* (s) and return 0, or return the seconds until there is one to take."""
        if now > self.at:  # inlined `fill`, because this method runs for each message of each robot
            self.tokens = min(self.burst, self.tokens + (now - self.at) * self.rate)
            self.at = now
        if self.tokens < 1.0:
            return (1.0 - self.tokens) / self.rate
        self.tokens -= 1.0
        return 0.0

    def wait_s(self, now: float) -> float:
        """Return the seconds until one token is available, 0 if one is available at *now*."""
        self.fill(now)
        return 0.0 if self.tokens >= 1.0 else (1.0 - self.tokens) / self.rate

    def spend(self, count: float, now: float) -> float:
        """Take *count* tokens, even if there are fewer; return the seconds to wait.

        The caller waits until the tokens that were taken in excess before this call are refilled; 0 if none.
        """
        self.fill(now)
        wait_s = max(0.0, -self.tokens) / self.rate
        self.tokens -= count
        return wait_s

    def is_full(self, now: float) -> bool:
        """Return whether all tokens that were taken have been refilled."""
        self.fill(now)
        return self.tokens >= self.burst

    def fill(self, now: float) -> None:
        """Add the tokens for the time from the last refill to *now*; an earlier *now* changes nothing."""
        if now > self.at:
            self.tokens = min(self.burst, self.tokens + (now - self.at) * self.rate)
            self.at = now
