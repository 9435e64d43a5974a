"""Decide when a robot sends a fresh token, before its connection expires with the former one.

The caller passes the time as ``now``: seconds of the robot's monotonic clock.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["RenewalTimer"]

# Fraction of a token's remaining validity after which a fresh token is sent first; the rest is left for
# further attempts.
_RENEW_AFTER = 0.8
# Shortest pause in seconds between two attempts; the server refuses a second one within 1 s.
_MIN_RENEWAL_PAUSE_S = 1.5
# Longest validity in seconds that a server can state; another value counts as this one.
_MAX_TTL_S = 3600.0


@dataclass(slots=True)
class RenewalTimer:
    """When one connection expires (``ends_s``, None if never), and when its token has to be renewed.

    A renewal without a reply is repeated, but not faster than the server accepts renewals.
    """

    ends_s: float | None = None
    _due_s: float = 0.0

    def expires_in(self, token_s: float, now: float) -> None:
        """Record that the connection expires in *token_s* seconds; a value outside 0..3600 counts as 3600."""
        left_s = token_s if 0.0 <= token_s <= _MAX_TTL_S else _MAX_TTL_S
        self.ends_s, self._due_s = now + left_s, now + _RENEW_AFTER * left_s

    def is_due(self, now: float) -> bool:
        """Return whether a fresh token is to be sent at *now*.

        If so, the next attempt is due after half of the remaining time, unless `expires_in` is called before.
        """
        if self.ends_s is None or now < self._due_s:
            return False
        self._due_s = now + max(_MIN_RENEWAL_PAUSE_S, (self.ends_s - now) / 2)
        return True
