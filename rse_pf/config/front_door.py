"""Rate limits of the web firewall for each source address, and limits of HTTP at the load balancer.

The robots of one site share a source address, because they are behind one router.  Each rate limit is the sum
of what the robots of a site may send by their own limits.  So all robots of a site may reconnect at the same
moment without being refused.  The stacks turn these rules into rules of AWS WAF.
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
"""Seconds after which the load balancer on AWS closes a silent connection; robots ping far more often."""

BODY_TIMEOUT_S = 10.0
"""Longest pause in seconds between two parts of a request body that the data service receives; the local load
balancer allows three times as long."""
MAX_HANDSHAKE_BYTES = 8192
"""Longest HTTP request head of a WebSocket handshake, in bytes; a longer one is answered with 431, so that
slow clients cannot fill the memory (OWASP, slowloris)."""
WRITE_BUFFER_BYTES = 262_144
"""Unsent bytes of a connection above which its client counts as a slow reader.  The answers to the commands
that a robot may have in flight take less."""
DIAL_BURST = 20
"""Attempts to connect that a robot may make at once, before `DIALS_PER_MINUTE` limits it."""
DIALS_PER_MINUTE = 10.0
"""Attempts to connect that a robot may make each minute after `DIAL_BURST`."""
DATA_REQUESTS_PER_MINUTE = 600
"""Requests to the data service of one robot in a minute, averaged over the robots of a site.
``data.max_requests_per_s`` limits each robot by itself."""
DATA_PATH = "/data/"
"""Prefix of the paths of objects and maps, which the data servers answer."""
LOCALISE_PATH = "/localise/"
"""Prefix of the paths to which photos are sent for localisation, which the data servers answer."""
BURST_PATH = "/burst"
"""Path at the robots' address to which commands for the serverless PnP are sent."""
BEARER_PATTERN = r"^[Bb]earer +[A-Za-z0-9_-]+\.[A-Za-z0-9_-]+\.[A-Za-z0-9_-]{86}$"
"""Form of the header Authorization with a robot token: three parts, of which the last is an Ed25519
signature.  The form does not show that the token is valid."""
STATUS = 429
"""HTTP status of the answer to a request above a rate limit: Too Many Requests."""
RETRY_AFTER_S = 60
"""Seconds in the header Retry-After of the answer to a request above a rate limit: after one window of
`_MINUTE_S` without requests, an address is below its limit."""
_ADDRESS_SHARE = 0.4
"""Fraction of the limit on burst commands of all robots that one source address may use, so that one site
cannot use the whole limit."""
_MINUTE_S = 60
"""Window of rate rules in seconds: the shortest of AWS WAF, so that an address is accepted again soon."""
_FIVE_MINUTES_S = 300
"""Window in seconds of the rate rules for burst commands: ``burst.commands_per_5_minutes``."""
_MIN_LIMIT = 10
"""The lowest limit, in requests of one window, that AWS WAF accepts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RateRule:
    """At most ``limit`` requests within ``window_s`` seconds, from one source address or from all together.

    Attributes:
        name: Name of the rule and of its metric.
        limit: Requests of one window above which further requests are refused.
        window_s: Length of the window in seconds.
        paths: The rule counts requests whose path begins with one of these.
        but: If ``paths`` is empty, the rule counts requests whose path begins with none of these.
        of_all: Whether the requests of all source addresses are counted together, not each address apart.
    """

    name: str
    limit: int
    window_s: int = _MINUTE_S
    paths: tuple[str, ...] = ()
    but: tuple[str, ...] = ()
    of_all: bool = False


def rate_rules(settings: PlatformSettings) -> tuple[RateRule, ...]:
    """Return the rate rules, in the order in which they are applied.

    The rule ``dials`` counts all requests that are neither for data nor burst commands, so that a request
    with an unknown path counts in the strictest rule.
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
