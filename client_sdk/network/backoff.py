"""When a robot dials again: soon after a loss, and less and less often while servers do not take it.

Only what reaches a server is spared: an attempt that nobody answered costs nothing, and another one follows a
second later.  The firewall in front of a platform counts the handshakes of an address, and many robots may
share one.  So a robot bounds its handshakes by itself, whatever happens to its connections: a token bucket
gives it `DIAL_BURST` attempts at once and `DIALS_PER_MINUTE` later.  The limit of the firewall is derived
from the same two numbers (`rse_pf.config.front_door`).  Nothing here dials or sleeps.
"""

from __future__ import annotations

from enum import Enum
from random import Random

from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config.front_door import DIAL_BURST, DIALS_PER_MINUTE
from rse_pf.token_bucket import TokenBucket

__all__ = ["Backoff", "Last"]

RECONNECT_BASE_S = 0.1
"""Longest first pause; it doubles with each attempt, with full jitter (AWS Architecture Blog, 2015)."""
_SHARE = 1.0 / 3.0
"""Longest pause as a share of the time in which attempts fail: after an outage of a minute, 20 seconds."""
_UNANSWERED_S = (1.0, 1.25)
"""Between the starts of two attempts that nobody answers; not all robots at once."""
_CUT_OFF_JITTER_S = 0.5
_KEPT = 0.5
_SPREAD = 1.25
"""Robots that are told the same time to wait do not come back at the same moment."""


class Last(Enum):
    """How the last attempt to connect ended."""

    NONE = "none"
    """There was none since the connection was lost."""
    UNANSWERED = "unanswered"
    """Nobody accepted the TCP connection, or nothing left the robot."""
    ANSWERED = "answered"
    """Something accepted the TCP connection, or refused it; the robot may connect a little later."""
    REFUSED = "refused"
    """A server of ours refused the robot, and may refuse it for long."""


class Backoff:
    """The pauses before the attempts of one robot to connect to one address."""

    def __init__(self, timings: ConnectTimings, random: Random) -> None:
        self._timings = timings
        self._random = random
        self._attempt = 0
        self._failing_since: float | None = None
        self._bucket = TokenBucket(DIALS_PER_MINUTE / 60.0, DIAL_BURST)

    def restart(self) -> None:
        """Begin with short pauses again: the last connection lasted, or the robot is asked to move."""
        self._attempt, self._failing_since = 0, None

    def dialled(self, now: float) -> None:
        """Count an attempt that was answered at *now*, seconds of the robot's clock."""
        self._bucket.spend(1.0, now)

    def pause_s(
        self,
        now: float,
        after_s: float = 0.0,
        *,
        last: Last = Last.ANSWERED,
        valid_in_s: float | None = None,
        is_move: bool = False,
    ) -> float:
        """Return how long to wait before the next attempt, from the start of the last one.

        Within the first seconds of attempts that are answered, exponential with full jitter up to
        ``reconnect_max_s``; then between a sixth and a third of that time, up to
        ``reconnect_long_max_s``.  After a refusal, between the half and the whole of the latter.

        Args:
            now: Seconds of the robot's clock.
            after_s: What the server asked for.
            last: How the last attempt ended.
            valid_in_s: When a token that is signed then will be accepted, None if that is not known.
            is_move: Whether the robot has a connection; it then keeps half of its allowance for its loss.
        """
        asked_s = after_s * self._random.uniform(1.0, _SPREAD)
        wait_s = self._bucket.wait_s(now)
        if is_move:
            least = _KEPT * self._bucket.burst
            wait_s = max(wait_s, (least + 1.0 - self._bucket.tokens) / self._bucket.rate)
        return max(asked_s + self._own_s(now, last, valid_in_s), wait_s)

    def _own_s(self, now: float, last: Last, valid_in_s: float | None) -> float:
        s, uniform = self._timings, self._random.uniform
        if last is Last.UNANSWERED:
            return uniform(*_UNANSWERED_S)
        if last is Last.REFUSED:
            pause_s = uniform(0.5 * s.reconnect_long_max_s, s.reconnect_long_max_s)
            if valid_in_s is None:
                return pause_s
            return min(pause_s, max(0.0, valid_in_s) + uniform(0.0, _CUT_OFF_JITTER_S))
        if self._failing_since is None and last is Last.ANSWERED:
            self._failing_since = now
        failing_s = 0.0 if self._failing_since is None else now - self._failing_since
        longest_s = min(s.reconnect_long_max_s, _SHARE * failing_s)
        attempt, self._attempt = self._attempt, self._attempt + 1
        if longest_s > s.reconnect_max_s:
            return uniform(0.5 * longest_s, longest_s)
        return uniform(0.0, min(s.reconnect_max_s, RECONNECT_BASE_S * 2.0 ** min(attempt, 16)))
