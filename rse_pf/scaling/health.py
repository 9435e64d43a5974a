"""Decide from health checks whether a server is healthy, by the rule of a target group of the AWS ALB.

A number of equal results in a row changes the state; failures count only after a grace period.  The ALB,
Envoy on one machine, and this rule use the same limits.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from rse_pf.config import HealthSettings, PlatformSettings
from rse_pf.config.resource_names import HEALTH_PATH, READY_PATH, ROSBRIDGE_PORT

__all__ = [
    "CLOUD_INTERVAL_S",
    "CLOUD_TIMEOUT_S",
    "DRAIN_S",
    "GRACE_S",
    "HEALTHY_CHECKS",
    "LOCAL_INTERVAL_S",
    "LOCAL_TIMEOUT_S",
    "MAX_HEALTHY_PERCENT",
    "Health",
    "cloud_checks",
    "observe",
    "time_to_notice_s",
]

# Number of successful checks in a row after which a server is healthy: the least that the ALB offers.
HEALTHY_CHECKS = 2
# Seconds between two checks of a server of a local platform: a crash is noticed within half a second.
LOCAL_INTERVAL_S = 0.25
# Time limit of a check of a server of a local platform, in seconds.
LOCAL_TIMEOUT_S = 0.25
# Seconds between two checks of the ALB: the least that it offers.
CLOUD_INTERVAL_S = 5
# Time limit of a check of the ALB, in seconds: it must be shorter than the interval.
CLOUD_TIMEOUT_S = 4
# Seconds after its start in which failed checks of a new server do not count: it is ready after about 75 s.
GRACE_S = 90
# Seconds in which a server must drain before its instance is terminated: the termination hook waits so long.
DRAIN_S = 60
# Most servers while some are replaced, in percent of the wanted number: fleets of up to 19 servers get one
# additional server at a time, so that a bad release stops at the first server.
MAX_HEALTHY_PERCENT = 110


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """The health of one server, as its checks up to now show it.

    Attributes:
        started_s: Time at which the server was started and its grace period began.
        state: ``starting`` until the server was healthy, or unhealthy after the grace period.
        last_ok: Whether the last check succeeded.
        row: Number of checks in a row with the result of the last one.
    """

    started_s: float
    state: Literal["starting", "healthy", "unhealthy"] = "starting"
    last_ok: bool = False
    row: int = 0


def cloud_checks(settings: PlatformSettings) -> dict[str, tuple[int, str]]:
    """Return port and path of the ALB's health check, for each target group by name.

    The groups are ``robots`` and, if these services are enabled, ``data`` and ``rosbridge``.  A server that
    fails any check is replaced.  Therefore no check may depend on a resource that all servers share, such as
    the bucket: its failure would replace all servers at once.
    """
    checks = {"robots": (settings.serving.control_port, READY_PATH)}
    if settings.data.enabled:
        checks["data"] = (settings.data.port, f"/data{HEALTH_PATH}")
    if settings.serving.rosbridge:
        checks["rosbridge"] = (ROSBRIDGE_PORT, HEALTH_PATH)
    return checks


def observe(health: Health, ok: bool, settings: HealthSettings, *, now_s: float) -> Health:
    """Return the health of a server after one more check, which succeeded if *ok*.

    A server becomes healthy after `HEALTHY_CHECKS` successes in a row, and unhealthy after
    ``settings.unhealthy_checks`` failures in a row.  A server that was never healthy becomes unhealthy only
    `GRACE_S` after its start.  *now_s* is on the clock of ``started_s``.
    """
    row = health.row + 1 if ok == health.last_ok else 1
    state = health.state
    if ok and row >= HEALTHY_CHECKS:
        state = "healthy"
    elif not ok and row >= settings.unhealthy_checks:
        in_grace = state == "starting" and now_s - health.started_s < GRACE_S
        state = "starting" if in_grace else "unhealthy"
    return dataclasses.replace(health, state=state, last_ok=ok, row=row)


def time_to_notice_s(settings: HealthSettings, *, local: bool) -> float:
    """Return the longest time in seconds until the load balancer notices that a server is not ready.

    A draining server keeps working for this time.  *local* selects a local platform instead of AWS.
    """
    interval_s = LOCAL_INTERVAL_S if local else CLOUD_INTERVAL_S
    timeout_s = LOCAL_TIMEOUT_S if local else CLOUD_TIMEOUT_S
    return interval_s * settings.unhealthy_checks + timeout_s
