"""When a robot shows a fresh token on a link, so that the socket outlives the token it was opened with.

Promises no clock, and that a server which answers nothing is asked again, but never more often than it bears.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["RenewalTimer"]

_RENEW_AFTER = 0.8
"""Of a token's rest; the fifth that is left is for a second and a third try."""
_AGAIN_S = 1.5
"""Above the server's own pause between two renewals."""
_MAX_S = 3600.0


@dataclass(slots=True)
class RenewalTimer:
    """What a server said of the end of one link; times are readings of the robot's clock, in seconds."""

    ends_s: float | None = None
    _due_s: float = 0.0

    def lasts(self, token_s: float, now: float) -> None:
        """Note that the link ends in *token_s*; what a server says is believed within an hour."""
        left_s = token_s if 0.0 <= token_s <= _MAX_S else _MAX_S
        self.ends_s, self._due_s = now + left_s, now + _RENEW_AFTER * left_s

    def is_due(self, now: float) -> bool:
        """Return whether to renew now; then again when half of what is left has passed."""
        if self.ends_s is None or now < self._due_s:
            return False
        self._due_s = now + max(_AGAIN_S, (self.ends_s - now) / 2)
        return True
