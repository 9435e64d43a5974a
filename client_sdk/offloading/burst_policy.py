"""Decide when a robot may send a command to the burst function (AWS Lambda), and to which address.

`BurstPolicy` holds a daily budget, a circuit breaker and the expected time of an answer; it sends nothing,
and gets the time as an argument.  `client_sdk.offloading.burst_client` sends the commands.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from rse_pf.errors import UsageError

__all__ = ["BurstPolicy", "burst_address", "check_burst_url"]

DAY_S = 86400.0
BREAKER_FAILURES = 3
"""After this many consecutive failures of the burst function the circuit breaker opens: the robot sends it no
command for a while."""
FIRST_OPEN_S = 1.0
"""How long the circuit breaker of the burst function stays open when it opens first, in seconds, before the
jitter multiplies it by 0.5 to 1; it doubles with each further failure."""
MAX_OPEN_S = 60.0
"""The open time of the circuit breaker of the burst function does not double beyond this, in seconds; only a
``Retry-After`` of the function keeps it open for longer."""
MAX_DOUBLINGS = 16
"""The open time of the circuit breaker stops doubling after this many failures, so that the number stays
finite."""
MAX_IN_FLIGHT = 8
"""Most commands of one robot that may be at the burst function without an answer.  After the circuit breaker
was open the limit is 1 until an answer arrives: this one command is a trial."""
RECENT_ANSWERS = 16
"""The expected time of the burst function is computed from at most this many of its last answers."""
ANSWER_MEMORY_S = 10.0
"""How long the measured time of an answer of the burst function counts for the expected time, in seconds: one
slow answer must not prevent all later attempts."""
EXPECTED_PERCENTILE = 0.75
"""The expected time of an answer of the burst function is this percentile (0..1, nearest rank) of the times
of its recent answers: three of four are at most as slow, so that a single slow one does not count."""


@dataclass(slots=True, kw_only=True)
class BurstPolicy:
    """Hold one robot's daily budget and circuit breaker for the burst function; times are in seconds.

    Attributes:
        commands_per_day: How many commands may be sent within 24 hours.  The 24 hours begin with the first
            call of `may_send` after the last 24 hours have ended.
        first_s: Expected time of an answer while there is no measured answer of the last 10 s.
        spent: Number of commands that were sent within the present 24 hours.
        in_flight: Number of commands that were sent and have no result yet.
    """

    commands_per_day: int
    first_s: float = 0.15
    spent: int = 0
    in_flight: int = 0
    _day_began_s: float = -math.inf
    _failures: int = 0
    _open_until_s: float = -math.inf
    _recent: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=RECENT_ANSWERS))
    """For each of the last answers, when it arrived and how long it took, in seconds."""

    def may_send(self, now_s: float) -> bool:
        """Return whether a command may be sent at *now_s*; count no command.

        If the last 24 hours have ended, the next ones begin now: `spent` becomes 0.
        """
        if now_s - self._day_began_s >= DAY_S:
            self._day_began_s, self.spent = now_s, 0
        max_in_flight = 1 if self._failures >= BREAKER_FAILURES else MAX_IN_FLIGHT
        is_closed = now_s >= self._open_until_s
        return self.spent < self.commands_per_day and is_closed and self.in_flight < max_in_flight

    def count_sent(self) -> None:
        """Count a command that is sent now.

        It is taken from the daily budget, whatever its result, and is in flight until `count_answer`,
        `count_failure` or `count_withdrawal` is called for it.
        """
        self.spent += 1
        self.in_flight += 1

    def count_answer(self, now_s: float, took_s: float | None) -> None:
        """Count an answer that arrived at *now_s*; it closes the circuit breaker.

        *took_s* is the time from the command to the answer in seconds; None after a cold start, whose time
        does not predict the next answer.
        """
        self.in_flight -= 1
        self._failures = 0
        if took_s is not None:
            self._recent.append((now_s, took_s))

    def count_failure(self, now_s: float, *, retry_after_s: float = 0.0, jitter: float = 0.5) -> None:
        """Count a failure of the burst function; the third one in a row opens the circuit breaker.

        Each later failure opens it again, for twice as long, up to `MAX_OPEN_S`.  A failure that arrives
        while the circuit breaker is open belongs to a command that was sent before, and does not count.

        Args:
            now_s: When the failure was noticed.
            retry_after_s: For how many seconds the function asked the robot to send it no command.  No
                command is sent during this time, even after the first failure.
            jitter: A random number, uniform in 0..1, that spreads the trials of many robots: the open time is
                multiplied by 0.5 + 0.5 *jitter*.
        """
        self.in_flight -= 1
        is_open = self._failures >= BREAKER_FAILURES and now_s < self._open_until_s
        # Commands that were in flight when the circuit breaker opened fail for the same cause, and do not
        # count.
        self._failures += not is_open
        open_s = 0.0
        if self._failures >= BREAKER_FAILURES and not is_open:
            doublings = min(self._failures - BREAKER_FAILURES, MAX_DOUBLINGS)
            open_s = min(MAX_OPEN_S, FIRST_OPEN_S * 2.0**doublings) * (0.5 + 0.5 * jitter)
        self._open_until_s = max(self._open_until_s, now_s + max(open_s, retry_after_s))

    def count_withdrawal(self) -> None:
        """Count a command that was cancelled before its result; the daily budget does not get it back."""
        self.in_flight -= 1

    def expected_s(self, now_s: float) -> float:
        """Return the expected seconds until an answer: the 75th percentile of the answers of the last 10 s.

        At most the last 16 answers count.  Without an answer in the last 10 s it is `first_s`.
        """
        times_s = sorted(took_s for at_s, took_s in self._recent if now_s - at_s < ANSWER_MEMORY_S)
        if not times_s:
            return self.first_s
        return times_s[max(0, math.ceil(EXPECTED_PERCENTILE * len(times_s)) - 1)]


def burst_address(url: str, own_url: str) -> str | None:
    """Return the HTTP address of the burst function for a robot that connects to *own_url*.

    Args:
        url: An absolute address, or a path that begins with ``/``, at the host and port of *own_url*.
        own_url: WebSocket address of the backend servers, ``ws://HOST:PORT/ws`` or ``wss://...``.

    Returns:
        An ``http:`` or ``https:`` address; None if *url* is malformed, or if it is ``http:`` while *own_url*
        is ``wss:``, because the token would be sent without TLS.
    """
    own = urlsplit(own_url)
    uses_tls = own.scheme == "wss"
    if url.startswith("/") and not url.startswith("//"):
        url = f"{'https' if uses_tls else 'http'}://{own.netloc.rpartition('@')[2]}{url}"
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError:
        return None
    if parts.scheme not in ("http", "https") or not parts.hostname or (uses_tls and parts.scheme == "http"):
        return None
    if any(not "!" <= letter <= "~" for letter in url):
        return None
    return url


def check_burst_url(url: str | None, own_url: str) -> str | None:
    """Return the address *url* of a burst function that the user gave, unchanged; None and "" are allowed.

    Raises:
        UsageError: `burst_address` refuses *url*: it is malformed, or the token would be sent without TLS.
    """
    if url and burst_address(url, own_url or "ws://an-enrolment-names-it/ws") is None:
        raise UsageError(
            f"burst_url={url!r} is no HTTP address that a robot may send its token to",
            hint="write https://HOST/burst, or /burst at the address of the servers; http: only with ws:",
        )
    return url
