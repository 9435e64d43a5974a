"""The health of a server by its checks, as in a target group of the ALB.

Consecutive results decide, after a grace period.  The ALB, Envoy and this rule use the same limits.
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

# Successful checks in a row after which a server is healthy: the least that the ALB offers.
HEALTHY_CHECKS = 2
# Seconds between two checks on one machine: a crash is noticed within half a second.
LOCAL_INTERVAL_S = 0.25
# Time limit of a check on one machine, in seconds.
LOCAL_TIMEOUT_S = 0.25
# Seconds between two checks of the ALB: the least that it offers.
CLOUD_INTERVAL_S = 5
# Time limit of a check of the ALB, in seconds: it must be shorter than the interval.
CLOUD_TIMEOUT_S = 4
# Seconds for which failed checks of a new server do not count: its start of about 75 s, and some more.
GRACE_S = 90
# Seconds that the termination hook gives a server to drain.
DRAIN_S = 60
# Largest percentage of the wanted servers while servers are replaced: one more at a time in fleets of up to
# 19, so that a bad release stops at the first server.
MAX_HEALTHY_PERCENT = 110


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """The health of one server.

    ``row`` counts equal results in a row; the grace period begins at ``started_s``.
    """

    started_s: float
    state: Literal["starting", "healthy", "unhealthy"] = "starting"
    last_ok: bool = False
    row: int = 0


def cloud_checks(settings: PlatformSettings) -> dict[str, tuple[int, str]]:
    """Return port and path of the ALB's check of each target group: ``robots``, and the services that run.

    A server that fails any check is replaced.  Therefore no check may depend on anything that all servers
    share, such as the bucket: its failure would replace all servers at once.
    """
    checks = {"robots": (settings.serving.control_port, READY_PATH)}
    if settings.data.enabled:
        checks["data"] = (settings.data.port, f"/data{HEALTH_PATH}")
    if settings.serving.rosbridge:
        checks["rosbridge"] = (ROSBRIDGE_PORT, HEALTH_PATH)
    return checks


def observe(health: Health, ok: bool, settings: HealthSettings, *, now_s: float) -> Health:
    """Return the health after one more check.

    A server becomes healthy after `HEALTHY_CHECKS` successes in a row, and unhealthy after
    ``unhealthy_checks`` failures; a server that was never healthy becomes unhealthy only after `GRACE_S`.
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
    """Return the longest time from a failure to its detection, in seconds; a drain waits for it."""
    interval_s = LOCAL_INTERVAL_S if local else CLOUD_INTERVAL_S
    timeout_s = LOCAL_TIMEOUT_S if local else CLOUD_TIMEOUT_S
    return interval_s * settings.unhealthy_checks + timeout_s
