"""Limit the messages of each robot, and the handshakes of each address, by token buckets.

A robot has one bucket for all of its sockets of one worker: ``session.max_commands_per_s`` tokens a second,
and at most `command_burst` tokens.  Each message takes one.  A message that finds the bucket empty is refused
with the time until the next token.  A robot that keeps sending is disconnected and banned:

1. `command_burst` refusals are one violation.
2. `_MAX_VIOLATIONS` violations within `_VIOLATIONS_WINDOW_S` end the connection with close code 4429.
3. Handshakes of that robot are refused for `RATE_BAN_S`.

A robot that keeps to its rate is never refused, and one a little above it gets refusals only.  An address has
a bucket for its handshakes.  Times and names go in, decisions come out, and memory is bounded whatever
unauthenticated clients send.

Source:
    Turner 1986, "New directions in communications" (token bucket).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import TypeVar

from rse_pf.auth.claimed import source_address
from rse_pf.config import ServingSettings, SessionSettings
from rse_pf.identity import RobotId
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.wire.rate_limit import command_burst

__all__ = ["CUT_OFF", "HANDSHAKE_BURST", "RATE_BAN_S", "RobotRates", "SourceRates"]

CUT_OFF = math.inf
"""Returned instead of a time to wait: the robot ignores refusals, so its connection is to be closed."""

RATE_BAN_S = 5.0  # handshakes of a disconnected robot are refused: otherwise it would resume at once
HANDSHAKE_BURST = 1000.0  # sockets or handshakes accepted at once above the rate: a fleet that reconnects
_MAX_NAMES = 20000  # robots or addresses remembered; those whose buckets are full are forgotten first
_MIN_RETRY_MS = 1.0  # shortest pause that a refused robot is given; 0 would accept its message
_MAX_VIOLATIONS = 3  # one violation may be a burst that was sent before its first refusal arrived
_VIOLATIONS_WINDOW_S = 10.0  # violations that lie further apart do not count together

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


@dataclass(slots=True)
class _Robot:
    bucket: TokenBucket
    refused: int = 0
    violations: deque[float] = field(default_factory=deque)
    banned_until: float = -math.inf


class RobotRates:
    """The token buckets, violations and bans of the robots of one worker."""

    def __init__(self, limits: SessionSettings, *, max_names: int = _MAX_NAMES) -> None:
        """Remember no robot yet, and never more than *max_names*."""
        self._limits = limits
        self._max_names = max_names
        self._robots: dict[RobotId, _Robot] = {}

    def __len__(self) -> int:
        """Return how many robots are remembered."""
        return len(self._robots)

    def retry_after_ms(self, robot: RobotId, now: float) -> float:
        """Take one token for a message of *robot* at *now* (s).

        Returns:
            0 if the message is accepted, else the milliseconds until the next token, or `CUT_OFF` if the
            connection is to be closed.
        """
        if self._limits.max_commands_per_s <= 0:
            return 0.0
        known = self._robots.get(robot) or self._add(robot, now)
        wait_s = known.bucket.take(now)
        if wait_s == 0.0:
            return 0.0
        if self._violations(known, now) >= _MAX_VIOLATIONS:
            known.violations.clear()
            known.banned_until = now + RATE_BAN_S
            return CUT_OFF
        return max(_MIN_RETRY_MS, wait_s * 1e3)

    def ban(self, robot: RobotId, now: float, seconds: float | None = None) -> None:
        """Refuse the handshakes of *robot* from *now* (s) for *seconds*, or for `RATE_BAN_S`."""
        known = self._robots.get(robot) or self._add(robot, now)
        known.banned_until = now + (RATE_BAN_S if seconds is None else seconds)

    def banned_s(self, robot: RobotId, now: float) -> float:
        """Return how many seconds of the ban of *robot* are left, 0 without a ban."""
        known = self._robots.get(robot)
        return 0.0 if known is None else max(0.0, known.banned_until - now)

    def _violations(self, known: _Robot, now: float) -> int:
        known.refused += 1
        if known.refused >= command_burst(self._limits.max_commands_per_s):
            known.refused = 0
            known.violations.append(now)
        while known.violations and now - known.violations[0] > _VIOLATIONS_WINDOW_S:
            known.violations.popleft()
        return len(known.violations)

    def _add(self, robot: RobotId, now: float) -> _Robot:
        if len(self._robots) >= self._max_names:
            remembered = {
                name: state
                for name, state in self._robots.items()
                if state.violations or state.banned_until > now or not state.bucket.is_full(now)
            }
            self._robots = _half(remembered, self._max_names)
        rate = self._limits.max_commands_per_s
        bucket = TokenBucket(rate, float(command_burst(rate)))
        known = self._robots[robot] = _Robot(bucket)
        return known


class SourceRates:
    """The token buckets of the addresses that send handshakes; checked before any token is read."""

    def __init__(self, serving: ServingSettings, *, max_names: int = _MAX_NAMES) -> None:
        """Remember no address yet, and never more than *max_names*."""
        self._serving = serving
        self._max_names = max_names
        self._sources: dict[str, TokenBucket] = {}

    def __len__(self) -> int:
        """Return how many addresses are remembered."""
        return len(self._sources)

    def wait_s(self, source: str, now: float) -> float:
        """Return 0 if *source* may shake hands at *now* (s), else the seconds until it may."""
        rate = self._serving.max_handshakes_per_source_per_s
        if rate <= 0:
            return 0.0
        bucket = self._sources.get(source)
        if bucket is None:
            if len(self._sources) >= self._max_names:
                remembered = {
                    name: bucket for name, bucket in self._sources.items() if not bucket.is_full(now)
                }
                self._sources = _half(remembered, self._max_names)
            bucket = self._sources[source] = TokenBucket(rate, HANDSHAKE_BURST)
        return bucket.take(now)

    def source(self, peer: str, forwarded_for: str) -> str:
        """Return the address that a handshake came from, see `source_address`."""
        return source_address(peer, forwarded_for, self._serving.trusted_proxies)


def _half(names: dict[Key, Value], max_names: int) -> dict[Key, Value]:
    """Return the newer names, at most half of *max_names*, so that forgetting stays rare."""
    return dict(list(names.items())[-max_names // 2 :])
