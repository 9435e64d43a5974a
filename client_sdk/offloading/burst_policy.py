"""When a robot may send a command to the burst function, and to which address.

Decisions only: a budget for each day, a circuit breaker, and the expected time of an answer.  Time is an
argument; `client_sdk.offloading.burst_client` sends.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from rse_pf.errors import UsageError

__all__ = ["BurstRules", "burst_address", "check_burst_url"]

_DAY_S = 86400.0
_FAILURES = 3
"""Consecutive failures that open the breaker."""
_FIRST_PAUSE_S, _MAX_PAUSE_S = 1.0, 60.0
_MAX_IN_FLIGHT = 8
_RECENT = 16
_FRESH_S = 10.0
"""After this an answer's time counts no more, so that a slow one does not end all attempts."""
_SHARE = 0.75


@dataclass(slots=True, kw_only=True)
class BurstRules:
    """The budget and the breaker of one robot.

    Attributes:
        commands_per_day: How many commands may be sent in 24 hours, counted from the first.
        first_s: Expected time of an answer, seconds, until one was measured.
        spent: Commands that were sent in the present 24 hours.
    """

    commands_per_day: int
    first_s: float = 0.15
    spent: int = 0
    in_flight: int = 0
    _day_began: float = -math.inf
    _failures: int = 0
    _closed_until: float = -math.inf
    _recent: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_RECENT))

    def may_send(self, now: float) -> bool:
        """Return whether a command may be sent at *now*, seconds."""
        if now - self._day_began >= _DAY_S:
            self._day_began, self.spent = now, 0
        allowed = 1 if self._failures >= _FAILURES else _MAX_IN_FLIGHT
        return self.spent < self.commands_per_day and now >= self._closed_until and self.in_flight < allowed

    def sent(self) -> None:
        """Count a command that is sent."""
        self.spent += 1
        self.in_flight += 1

    def answered(self, now: float, took_s: float | None) -> None:
        """Record an answer that arrived at *now*: the function works.

        Args:
            now: Seconds.
            took_s: How long it took; None where an execution was started for it, which says nothing of the
                next one.
        """
        self.in_flight -= 1
        self._failures = 0
        if took_s is not None:
            self._recent.append((now, took_s))

    def failed(self, now: float, *, retry_after_s: float = 0.0, jitter: float = 0.5) -> None:
        """Record a failure of the function.

        Args:
            now: Seconds.
            retry_after_s: How long the function asked the robot to stay away.
            jitter: Uniform in 0..1; the pause is between its half and the whole.
        """
        self.in_flight -= 1
        is_open = self._failures >= _FAILURES and now < self._closed_until
        self._failures += not is_open  # several in flight fail by one cause
        pause_s = 0.0
        if self._failures >= _FAILURES and not is_open:
            doubled = min(self._failures - _FAILURES, 16)
            pause_s = min(_MAX_PAUSE_S, _FIRST_PAUSE_S * 2.0**doubled) * (0.5 + 0.5 * jitter)
        self._closed_until = max(self._closed_until, now + max(pause_s, retry_after_s))

    def withdrawn(self) -> None:
        """Record that the robot no longer waits for a command that was sent; it stays spent."""
        self.in_flight -= 1

    def expected_s(self, now: float) -> float:
        """Return the time within which an answer is expected, seconds: three of four recent ones were."""
        fresh = sorted(took_s for at, took_s in self._recent if now - at < _FRESH_S)
        return fresh[max(0, math.ceil(_SHARE * len(fresh)) - 1)] if fresh else self.first_s


def burst_address(url: str, own_url: str) -> str | None:
    """Return the address of HTTP that *url* means for a robot that connects to *own_url*.

    Args:
        url: An address, or a path at the robot's own address.
        own_url: ``ws://HOST:PORT/ws`` or ``wss://...``.

    Returns:
        None if *url* is none, or would send the token of a robot that uses TLS without TLS.
    """
    own = urlsplit(own_url)
    secure = own.scheme == "wss"
    if url.startswith("/") and not url.startswith("//"):
        url = f"{'https' if secure else 'http'}://{own.netloc.rpartition('@')[2]}{url}"
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError:
        return None
    if parts.scheme not in ("http", "https") or not parts.hostname or (secure and parts.scheme == "http"):
        return None
    if any(not "!" <= letter <= "~" for letter in url):
        return None
    return url


def check_burst_url(url: str | None, own_url: str) -> str | None:
    """Return *url*, given by the user; raises UsageError if it is no address that may be used."""
    if url and burst_address(url, own_url or "ws://an-enrolment-names-it/ws") is None:
        raise UsageError(
            f"burst_url={url!r} is not an address that takes commands",
            hint="write https://HOST/burst, or /burst at the address of the servers; http: only beside ws:",
        )
    return url
