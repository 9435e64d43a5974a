"""Decide when a robot sends a fresh token, before its connection expires; times in, decisions out."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["RenewalTimer"]

# Share of a token's remaining time; the rest is for a second and a third attempt.
_RENEW_AFTER = 0.8
# Above the server's minimum pause between two renewals.
_MIN_RENEWAL_PAUSE_S = 1.5
_MAX_TTL_S = 3600.0


@dataclass(slots=True)
class RenewalTimer:
    """The times at which a connection expires and its token is renewed; seconds of the robot's clock.

    A renewal without a reply is repeated, but never faster than the server accepts renewals.
    """

    ends_s: float | None = None
    _due_s: float = 0.0

    def expires_in(self, token_s: float, now: float) -> None:
        """Record that the connection expires in *token_s*; a value outside 0..3600 counts as 3600."""
        left_s = token_s if 0.0 <= token_s <= _MAX_TTL_S else _MAX_TTL_S
        self.ends_s, self._due_s = now + left_s, now + _RENEW_AFTER * left_s

    def is_due(self, now: float) -> bool:
        """Return whether to renew now; the next attempt is due after half of the remaining time."""
        if self.ends_s is None or now < self._due_s:
            return False
        self._due_s = now + max(_MIN_RENEWAL_PAUSE_S, (self.ends_s - now) / 2)
        return True
