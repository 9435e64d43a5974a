"""How many requests of one address the web firewall lets pass.

Many robots may share an address: those of one site stand behind one router.  The limit of each rule is what
the robots of a site do at the most, computed from the numbers by which they bound themselves; so robots that
all lose their connection at the same moment stay below it.  Pure arithmetic: the stacks write these rules
down, and tests play them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rse_pf.config.settings import PlatformSettings

__all__ = [
    "BALANCER_IDLE_TIMEOUT_S",
    "BEARER_PATTERN",
    "BODY_TIMEOUT_S",
    "BURST_PATH",
    "DATA_PATH",
    "DIALS_PER_MINUTE",
    "DIAL_BURST",
    "LOCALISE_PATH",
    "MAX_HANDSHAKE_BYTES",
    "RETRY_AFTER_S",
    "STATUS",
    "WRITE_BUFFER_BYTES",
    "RateRule",
    "rate_rules",
]

BALANCER_IDLE_TIMEOUT_S = 120
"""How long the load balancer on AWS keeps a silent connection; robots ping far more often."""

BODY_TIMEOUT_S = 10.0
"""A request body of the data service that pauses for longer is refused; the local balancer waits three times
as long."""
MAX_HANDSHAKE_BYTES = 8192
"""Request head of a handshake; load balancer and server refuse a longer one with 431 (OWASP, slowloris)."""
# A client with more unsent bytes than this counts as a slow reader; its answers in flight are fewer.
WRITE_BUFFER_BYTES = 262_144
DIAL_BURST = 20
"""Attempts to connect that a robot may make at once."""
DIALS_PER_MINUTE = 10.0
"""Attempts to connect of a robot after the burst."""
DATA_REQUESTS_PER_MINUTE = 600
"""Data requests of one robot, averaged over the robots of a site; ``data.max_requests_per_s`` bounds each
alone."""
DATA_PATH, LOCALISE_PATH = "/data/", "/localise/"
"""What the data servers answer."""
BURST_PATH = "/burst"
"""At the robots' address, where the serverless PnP answers."""
BEARER_PATTERN = r"^[Bb]earer +[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+\.[A-Za-z0-9_-]{86}$"
"""What the header Authorization looks like with a token: three parts, the last one an Ed25519 signature."""
STATUS = 429
RETRY_AFTER_S = 60
"""What an address above its limit is told: after one window without requests it is below."""
_ADDRESS_SHARE = 0.4
"""Share of the burst commands of all robots that one address may send: a site cannot take all of them."""
_MINUTE_S = 60
"""The shortest window that AWS WAF has, so that an address is free again soon."""
_FIVE_MINUTES_S = 300
_LEAST = 10
"""AWS WAF accepts no lower limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RateRule:
    """At most ``limit`` requests within ``window_s`` seconds, of one address or ``of_all``.

    It counts paths that begin with one of ``paths``, or with ``but`` all that begin with none of these.
    """

    name: str
    limit: int
    window_s: int = _MINUTE_S
    paths: tuple[str, ...] = ()
    but: tuple[str, ...] = ()
    of_all: bool = False


def rate_rules(settings: PlatformSettings) -> tuple[RateRule, ...]:
    """Return the rules, in the order in which they are applied.

    Dials are what is neither data nor burst, so that a path that is written in an unusual way counts in the
    strictest rule.
    """
    robots, burst = settings.cloud.robots_per_site, settings.burst
    dials = robots * (DIAL_BURST + DIALS_PER_MINUTE)
    requests = robots * DATA_REQUESTS_PER_MINUTE
    return (
        RateRule(name="dials", limit=_limit(dials), but=(DATA_PATH, LOCALISE_PATH, BURST_PATH)),
        RateRule(name="data", limit=_limit(requests), paths=(DATA_PATH, LOCALISE_PATH)),
        RateRule(
            name="burst",
            limit=_limit(_ADDRESS_SHARE * burst.commands_per_5_minutes),
            window_s=_FIVE_MINUTES_S,
            paths=(BURST_PATH,),
        ),
        RateRule(
            name="burst-of-all",
            limit=burst.commands_per_5_minutes,
            window_s=_FIVE_MINUTES_S,
            paths=(BURST_PATH,),
            of_all=True,
        ),
    )


def _limit(requests: float) -> int:
    return max(_LEAST, math.ceil(requests))
