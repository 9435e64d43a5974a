"""The token bucket that limits every rate: commands, handshakes, recorded refusals, background uploads."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

__all__ = ["TokenBucket"]


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
        if now > self.at:  # as `fill` does, without the call: each message of each robot takes a token
            self.left = min(self.burst, self.left + (now - self.at) * self.rate)
            self.at = now
        if self.left < 1.0:
            return (1.0 - self.left) / self.rate
        self.left -= 1.0
        return 0.0

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
