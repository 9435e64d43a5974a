"""When a robot dials again: soon after a loss, and less and less often while nobody answers.

The firewall in front of a platform counts the handshakes of an address, and many robots may share one.  So a
robot bounds its handshakes by itself, whatever happens to its connections: a token bucket gives it
``session.dial_burst`` attempts at once and ``session.dials_per_minute`` later.  The limit of the firewall is
derived from the same two settings (`rse_pf.config.front_door`).  Nothing here dials or sleeps.
"""

from __future__ import annotations

from random import Random

from rse_pf.config import SessionSettings
from rse_pf.token_bucket import TokenBucket

__all__ = ["Backoff"]

_SHARE = 1.0 / 3.0
"""Longest pause as a share of the time without a connection: after an outage of a minute, 20 seconds."""
_OFFLINE_MAX_S = 5.0
"""Longest pause while attempts do not leave the robot: they cost nobody anything."""
_KEPT = 0.5
_SPREAD = 1.25
"""Robots that are told the same time to wait do not come back at the same moment."""


class Backoff:
    """The pauses before the attempts of one robot to connect to one address."""

    def __init__(self, settings: SessionSettings, random: Random) -> None:
        self._settings = settings
        self._random = random
        self._attempt = 0
        self._failing_since: float | None = None
        self._bucket = TokenBucket(settings.dials_per_minute / 60.0, settings.dial_burst)

    def restart(self) -> None:
        """Begin with short pauses again: the last connection lasted, or the robot is asked to move."""
        self._attempt, self._failing_since = 0, None

    def dialled(self, now: float) -> None:
        """Count an attempt that begins at *now*, seconds of the robot's clock."""
        self._bucket.spend(1.0, now)

    def pause_s(
        self, now: float, after_s: float = 0.0, *, is_offline: bool = False, is_move: bool = False
    ) -> float:
        """Return how long to wait before the next attempt.

        Within the first seconds without a connection, exponential with full jitter up to
        ``session.reconnect_max_s``; then between a sixth and a third of the time without a connection, up to
        ``session.reconnect_long_max_s``.

        Args:
            now: Seconds of the robot's clock.
            after_s: What the server asked for.
            is_offline: Whether the last attempt did not leave the robot.
            is_move: Whether the robot has a connection; it then keeps half of its allowance for its loss.
        """
        s = self._settings
        if self._failing_since is None:
            self._failing_since = now
        longest_s = min(s.reconnect_long_max_s, _SHARE * (now - self._failing_since))
        if is_offline:
            longest_s = min(longest_s, _OFFLINE_MAX_S)
            self._bucket.spend(-1.0, now)
        if longest_s > s.reconnect_max_s:
            pause_s = self._random.uniform(0.5 * longest_s, longest_s)
        else:
            pause_s = self._random.uniform(
                0.0, min(s.reconnect_max_s, s.reconnect_base_s * 2.0 ** min(self._attempt, 16))
            )
        self._attempt += 1
        asked_s = after_s * self._random.uniform(1.0, _SPREAD)
        wait_s = self._bucket.wait_s(now)
        if is_move:
            kept = _KEPT * self._bucket.burst
            wait_s = max(wait_s, (kept + 1.0 - self._bucket.left) / self._bucket.rate)
        return max(asked_s + pause_s, wait_s)
