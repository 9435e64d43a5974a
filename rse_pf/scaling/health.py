"""The health of a server by its checks, as in a target group, and for how long a server may drain.

Consecutive results decide, after a grace period.  The ALB, Envoy and this rule use the same settings.  The
result of a check and the time are arguments.
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

HEALTHY_CHECKS = 2
"""Good checks in a row that bring a server in."""
LOCAL_INTERVAL_S, LOCAL_TIMEOUT_S = 0.25, 0.25
"""Time between checks on one machine; a check that takes longer than the second failed."""
CLOUD_INTERVAL_S, CLOUD_TIMEOUT_S = 5, 4
"""Time between checks of the ALB, the least it offers; a check that takes longer than the second failed."""
# Failed checks of a new server do not count for this long: its boot and start of 60 s, and some more.
GRACE_S = 90
DRAIN_S = 60
"""Time that the termination hook of a cloud gives a server to drain."""

MAX_HEALTHY_PERCENT = 110
"""While servers are replaced: one new one more at a time, up to 19 servers, and never fewer than wanted.

So a bad release, or a check that fails on every server at once, stops at the first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """The health of one server.  ``row`` counts equal results; the grace period begins at ``started_s``."""

    started_s: float
    state: Literal["starting", "healthy", "unhealthy"] = "starting"
    last_ok: bool = False
    row: int = 0


def cloud_checks(settings: PlatformSettings) -> dict[str, tuple[int, str]]:
    """Return port and path that the ALB asks, by target group: ``robots``, and what else runs.

    A server that fails any of them is ended.  Therefore none may depend on what all servers share, such as
    the bucket: it would end all servers at once.
    """
    checks = {"robots": (settings.serving.control_port, READY_PATH)}
    if settings.data.enabled:
        checks["data"] = (settings.data.port, f"/data{HEALTH_PATH}")
    if settings.serving.rosbridge:
        checks["rosbridge"] = (ROSBRIDGE_PORT, HEALTH_PATH)
    return checks


def observe(health: Health, ok: bool, settings: HealthSettings, *, now_s: float) -> Health:
    """Return the health after one more check.

    A server becomes healthy after `HEALTHY_CHECKS` good ones in a row, and unhealthy after
    ``unhealthy_checks`` failed ones; one that was never healthy only after `GRACE_S`.
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
