"""Limit the messages of each robot, and the handshakes of each address, by token buckets.

The rule for the messages of a robot, all of its sockets of one worker together:

1. Its bucket gains ``session.max_commands_per_s`` tokens a second, and holds at most `command_burst` tokens:
   those of two seconds.
2. A message takes one token.  Without a token it is refused, with the time until the next token.
3. `command_burst` refusals are one violation.
4. `_MAX_VIOLATIONS` violations within `_VIOLATIONS_WINDOW_S` close the connection with the code 4429.
5. After that, handshakes of the robot are refused for `RATE_BAN_S`.

A robot that keeps to its rate is never refused, and a robot a little above its rate is refused but never
disconnected.  A handshake takes a token from the bucket of its address, which gains
``serving.max_handshakes_per_source_per_s`` tokens a second and holds at most `HANDSHAKE_BURST`; without a
token it is refused.  The number of robots and addresses in memory is bounded.  Times go in, decisions come
out.

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
"""Result of `RobotRates.retry_after_ms` for a robot that ignores refusals: close its connection."""

# Seconds for which a robot cannot connect after it was disconnected for its rate or undecodable messages.
RATE_BAN_S = 5.0
HANDSHAKE_BURST = 1000.0  # sockets, or handshakes of one address, accepted at once: a fleet that reconnects
_MAX_NAMES = 20000  # robots, or addresses, in memory at most; those with full buckets are forgotten first
_MIN_RETRY_MS = 1.0  # shortest pause of a refused robot in milliseconds: 0 would mean that it was accepted
_MAX_VIOLATIONS = 3  # violations that close a connection: one may be a burst sent before the first refusal
_VIOLATIONS_WINDOW_S = 10.0  # seconds after which a violation is forgotten

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


@dataclass(slots=True)
class _Robot:
    """The state of one robot; ``refused`` counts refusals since the last violation."""

    bucket: TokenBucket
    refused: int = 0
    violations: deque[float] = field(default_factory=deque)
    banned_until: float = -math.inf


class RobotRates:
    """The token buckets, violations and bans of the robots of one worker."""

    def __init__(self, limits: SessionSettings, *, max_names: int = _MAX_NAMES) -> None:
        """Know no robot yet; the state of at most *max_names* robots is kept in memory."""
        self._limits = limits
        self._max_names = max_names
        self._robots: dict[RobotId, _Robot] = {}

    def __len__(self) -> int:
        """Return the number of robots whose state is in memory."""
        return len(self._robots)

    def retry_after_ms(self, robot: RobotId, now: float) -> float:
        """Take one token for a message of *robot* that arrived at *now* (monotonic s).

        Returns:
            0 if the message is accepted, or if there is no limit.  Otherwise the milliseconds until the next
            token, or `CUT_OFF` if the robot is banned from now on and its connection must be closed.
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
        """Refuse the handshakes of *robot* from *now* (s) for *seconds*; None means `RATE_BAN_S`."""
        known = self._robots.get(robot) or self._add(robot, now)
        known.banned_until = now + (RATE_BAN_S if seconds is None else seconds)

    def banned_s(self, robot: RobotId, now: float) -> float:
        """Return the seconds from *now* until the ban of *robot* ends; 0 if it is not banned."""
        known = self._robots.get(robot)
        return 0.0 if known is None else max(0.0, known.banned_until - now)

    def _violations(self, known: _Robot, now: float) -> int:
        """Count one refusal, and return the number of violations within the window."""
        known.refused += 1
        if known.refused >= command_burst(self._limits.max_commands_per_s):
            known.refused = 0
            known.violations.append(now)
        while known.violations and now - known.violations[0] > _VIOLATIONS_WINDOW_S:
            known.violations.popleft()
        return len(known.violations)

    def _add(self, robot: RobotId, now: float) -> _Robot:
        """Return the state of a new robot, with a full bucket.

        If too many robots are in memory, forget first those without ban and violation whose bucket is full,
        then the oldest ones.
        """
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
    """The token buckets of the addresses that send handshakes; checked before a robot's token is verified."""

    def __init__(self, serving: ServingSettings, *, max_names: int = _MAX_NAMES) -> None:
        """Know no address yet; the buckets of at most *max_names* addresses are kept in memory."""
        self._serving = serving
        self._max_names = max_names
        self._sources: dict[str, TokenBucket] = {}

    def __len__(self) -> int:
        """Return the number of addresses whose buckets are in memory."""
        return len(self._sources)

    def wait_s(self, source: str, now: float) -> float:
        """Take one token of the address *source* for a handshake at *now* (s).

        Return 0 if the handshake is accepted, else the seconds until the next token.
        """
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
        """Return the address that a handshake came from: *peer*, or an entry of the header X-Forwarded-For.

        Which of them depends on ``serving.trusted_proxies``, see `source_address`.
        """
        return source_address(peer, forwarded_for, self._serving.trusted_proxies)


def _half(names: dict[Key, Value], max_names: int) -> dict[Key, Value]:
    """Return the newest entries, at most half of *max_names*, so that this is rarely called."""
    return dict(list(names.items())[-max_names // 2 :])
