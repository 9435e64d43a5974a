"""Limit the messages of each robot, and the handshakes of each address.

Times and names go in, decisions come out.  The memory is bounded whatever strangers send, and a robot that
keeps to its rate is never refused.
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
"""The robot ignores refusals, so that its connection ends: it may not try again at all."""

# A robot that was disconnected for its rate is refused for this long.
RATE_BAN_S = 5.0
HANDSHAKE_BURST = 1000.0
"""Sockets or handshakes above their rate that are accepted at once: a fleet that comes back."""
_MAX_NAMES = 20000
"""Robots or addresses remembered at a time; those that did nothing wrong are forgotten first."""
_MIN_RETRY_MS = 1.0  # a refused robot waits at least this long, in ms

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")
_MAX_VIOLATIONS, _VIOLATIONS_WINDOW_S = 3, 10.0
"""A violation is `command_burst` refusals; so many within the window close the socket with 4429."""


@dataclass(slots=True)
class _Robot:
    bucket: TokenBucket
    refused: int = 0
    violations: deque[float] = field(default_factory=deque)
    banned_until: float = -math.inf


class RobotRates:
    """The rate of each robot, over all of its sockets of one worker.

    A violation is `command_burst` refusals: a robot a little above its rate gets refusals only, one
    far above it is cut off within a second and banned for `RATE_BAN_S`.
    """

    def __init__(self, limits: SessionSettings, *, max_names: int = _MAX_NAMES) -> None:
        """Remember no robot yet, and never more than *max_names*."""
        self._limits = limits
        self._max_names = max_names
        self._robots: dict[RobotId, _Robot] = {}

    def __len__(self) -> int:
        """Return how many robots are remembered."""
        return len(self._robots)

    def retry_after_ms(self, robot: RobotId, now: float) -> float:
        """Take one more message of *robot* and return 0, or return when it may try again.

        `CUT_OFF` ends the connection.  *now* is in seconds.
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
        """Refuse the handshakes of *robot*, cut off at *now* (s), for *seconds* or `RATE_BAN_S`."""
        known = self._robots.get(robot) or self._add(robot, now)
        known.banned_until = now + (RATE_BAN_S if seconds is None else seconds)

    def banned_s(self, robot: RobotId, now: float) -> float:
        """Return for how many seconds more *robot* is banned, 0 if it is not."""
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
    """The rate of handshakes of each address; judged before any token is read."""

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
