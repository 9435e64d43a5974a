"""Rate limits of the web firewall for each source address, and limits of HTTP at the load balancer.

The robots of one site share an address, because they are behind one router.  Each rate limit is the most that
the robots of a site send by their own limits, so robots that lose their connection at the same moment stay
below it.  The stacks turn these rules into rules of AWS WAF.
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
"""Longest pause within a request body of the data service; the local load balancer allows thrice this."""
MAX_HANDSHAKE_BYTES = 8192
"""Longest request head of a handshake; longer ones are answered with 431 (OWASP, slowloris)."""
WRITE_BUFFER_BYTES = 262_144
"""Unsent bytes above which a client counts as a slow reader; its answers in flight take less."""
DIAL_BURST = 20
"""Attempts to connect that a robot may make at once."""
DIALS_PER_MINUTE = 10.0
"""Attempts to connect of a robot in a minute after the burst."""
DATA_REQUESTS_PER_MINUTE = 600
"""Data requests of a robot, averaged over a site; ``data.max_requests_per_s`` limits each single robot."""
DATA_PATH = "/data/"
"""Paths of objects and maps, which the data servers answer."""
LOCALISE_PATH = "/localise/"
"""Paths of photos to localise, which the data servers answer."""
BURST_PATH = "/burst"
"""Path at the robots' address that the serverless PnP answers."""
BEARER_PATTERN = r"^[Bb]earer +[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+\.[A-Za-z0-9_-]{86}$"
"""What the header Authorization looks like with a token: three parts, the last one an Ed25519 signature."""
STATUS = 429
"""Status of a refused request: Too Many Requests."""
RETRY_AFTER_S = 60
"""Value of Retry-After in a refusal: after one window without requests an address is below its limit."""
_ADDRESS_SHARE = 0.4
"""Share of the burst commands of all robots that one address may send, so that no site uses all of them."""
_MINUTE_S = 60
"""The shortest window of AWS WAF, so that an address is accepted again soon."""
_FIVE_MINUTES_S = 300
"""Window of the limits of burst commands, which are set for five minutes."""
_MIN_LIMIT = 10
"""The lowest limit that AWS WAF accepts."""


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

    Dials are all requests that are neither data nor burst, so that an unusual path counts in the strictest
    rule.
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
    return max(_MIN_LIMIT, math.ceil(requests))
