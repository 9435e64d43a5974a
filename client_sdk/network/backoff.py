"""Decide how long a robot waits before its next attempt to connect, without sleeping or connecting.

Two rules bound the attempts:

    1. Pauses grow while attempts fail that a machine answered, which means that it accepted or refused the
       TCP connection (exponential backoff with full jitter).  An attempt that nobody answers reaches no
       server, so the next one starts 1 to 1.25 s later, however many attempts have failed.
    2. A token bucket bounds the attempts that are answered: `DIAL_BURST` at once, then `DIALS_PER_MINUTE`
       (both in `rse_pf.config.front_door`).  Pauses alone would not bound them while a server accepts
       connections and closes them.  The web firewall of the platform counts attempts by IP address; its
       limit is the sum of these two numbers, times the number of robots that may share one address.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.dial_errors import DialError
from rse_pf.config.front_door import DIAL_BURST, DIALS_PER_MINUTE
from rse_pf.limits.token_bucket import TokenBucket

__all__ = ["Backoff"]

RECONNECT_BASE_S = 0.1
"""Upper limit of the first pause before a reconnect, in seconds.  The limit doubles with each attempt, and a
pause is a random time from 0 to its limit ("full jitter", AWS Architecture Blog, 2015)."""
MAX_PAUSE_RATIO = 1.0 / 3.0
"""Once attempts have failed for more than three times ``reconnect_max_s``, a pause is at most this share of
the time for which they have failed: after an outage of a minute a robot is back within 20 seconds."""
UNANSWERED_MIN_S = 1.0
"""The time between the starts of two attempts that nobody answers is at least this many seconds; it does not
grow with the number of attempts, because they load no server."""
UNANSWERED_MAX_S = 1.25
"""The time between the starts of two attempts that nobody answers is random up to this many seconds, so that
robots of one site do not dial at the same moment."""
REVOCATION_JITTER_S = 0.5
"""After a revocation, a robot dials at a random time within this many seconds from the moment at which new
bearer tokens are accepted, so that not all robots dial at once."""
MOVE_RESERVE = 0.5
"""While a robot is connected and moves to another server, this share of its token bucket is kept for the case
that it loses its connection."""
RETRY_AFTER_SPREAD = 1.25
"""The time that a server asked for (``Retry-After``) is multiplied by a random number from 1 to this one, so
that robots that got the same time do not come back at the same moment."""
MAX_PAUSE_DOUBLINGS = 16
"""The limit of the exponential pause stops doubling after this many attempts, so that it stays finite."""


class Backoff:
    """Compute the pauses before the attempts of one robot to connect to one address."""

    def __init__(self, timings: ConnectTimings, random: Random, wall_clock: Callable[[], float]) -> None:
        """Begin with short pauses and a full token bucket.

        Args:
            timings: Longest pauses.
            random: Source of the jitter.
            wall_clock: Unix seconds, by which servers state when they accept tokens again.
        """
        self._timings = timings
        self._random = random
        self._wall_clock = wall_clock
        self._attempts = 0
        self._failing_since_s: float | None = None
        self._bucket = TokenBucket(DIALS_PER_MINUTE / 60.0, DIAL_BURST)

    def reset(self) -> None:
        """Return to short pauses.

        Call this after a connection that lasted longer than ``reconnect_max_s``, and before a move to another
        server.  The token bucket is not refilled.
        """
        self._attempts = 0
        self._failing_since_s = None

    def count_attempt(self, now_s: float) -> None:
        """Take one token from the bucket for an attempt that was answered at *now_s*, seconds of the robot's
        clock."""
        self._bucket.spend(1.0, now_s)

    def pause_s(
        self,
        now_s: float,
        failure: DialError | None = None,
        *,
        spent_s: float = 0.0,
        is_move: bool = False,
    ) -> float:
        """Return how many seconds to wait from now before the next attempt.

        Call it once for each attempt: each call makes later pauses longer, unless the last attempt was
        refused or not answered.  The pause is a random time:

            - after an attempt that was answered and failed: from 0 to a limit that doubles up to
              ``reconnect_max_s``; once attempts have failed for more than three times ``reconnect_max_s``, a
              sixth to a third of the time for which they have failed, up to ``reconnect_long_max_s``;
            - after an attempt that nobody answered: 1 to 1.25 s;
            - after a refusal: half of ``reconnect_long_max_s`` to all of it, but at most until half a second
              after the time from which the servers accept new tokens.

        The time that the server asked for (``Retry-After``), times 1 to 1.25, is added, and the token bucket
        may demand a longer pause.  The duration of the last attempt is a part of the pause, except after a
        refusal; the result is still at least the time that the server asked for.

        Args:
            now_s: Seconds of the robot's clock.
            failure: Failure of the last attempt; None if none has failed since the connection was lost.
            spent_s: Duration of the last attempt, in seconds.
            is_move: Whether the robot is connected and only changes the server; half of the token bucket then
                stays in reserve.
        """
        retry_after_s = 0.0 if failure is None else failure.retry_after_s
        asked_s = retry_after_s * self._random.uniform(1.0, RETRY_AFTER_SPREAD)
        bucket_s = self._bucket.wait_s(now_s)
        if is_move:
            missing_tokens = MOVE_RESERVE * self._bucket.burst + 1.0 - self._bucket.tokens
            bucket_s = max(bucket_s, missing_tokens / self._bucket.rate)
        pause_s = max(asked_s + self._backoff_s(now_s, failure), bucket_s)
        if failure is not None and failure.is_refusal:
            return pause_s
        return max(retry_after_s, pause_s - spent_s)

    def _backoff_s(self, now_s: float, failure: DialError | None) -> float:
        timings, uniform = self._timings, self._random.uniform
        if failure is not None and failure.is_refusal:
            pause_s = uniform(0.5 * timings.reconnect_long_max_s, timings.reconnect_long_max_s)
            valid_in_s = failure.valid_in_s(self._wall_clock())
            if valid_in_s is None:
                return pause_s
            return min(pause_s, max(0.0, valid_in_s) + uniform(0.0, REVOCATION_JITTER_S))
        if failure is not None and failure.is_unanswered:
            return uniform(UNANSWERED_MIN_S, UNANSWERED_MAX_S)
        if self._failing_since_s is None and failure is not None:
            self._failing_since_s = now_s
        failing_s = 0.0 if self._failing_since_s is None else now_s - self._failing_since_s
        longest_s = min(timings.reconnect_long_max_s, MAX_PAUSE_RATIO * failing_s)
        doublings = min(self._attempts, MAX_PAUSE_DOUBLINGS)
        self._attempts += 1
        if longest_s > timings.reconnect_max_s:
            return uniform(0.5 * longest_s, longest_s)
        return uniform(0.0, min(timings.reconnect_max_s, RECONNECT_BASE_S * 2.0**doublings))
