"""Constants of a deployment on AWS that the stacks build with and that an estimate of cost counts."""

from __future__ import annotations

from rse_pf.config.settings import PlatformSettings

__all__ = [
    "CANARY_MB",
    "CANARY_PERIOD_S",
    "DELETED_DAYS",
    "ENDPOINT_SERVICES",
    "IDLE_HOURS",
    "LAMBDA_MEMORY_MB",
    "LOG_DAYS",
    "ON_DEMAND_SERVERS",
    "RESUME_FIELD",
    "VOLUME_GB",
    "parks_when_idle",
    "zone_count",
]

# Memory of the serverless PnP: with it AWS gives one whole vCPU, and a command uses one.
LAMBDA_MEMORY_MB = 1769
# Memory of the canary's function: a third of a vCPU, with which a start and one pose fit into its time limit.
CANARY_MB = 512
# Time between two calls of the canary: one in each period of its alarm.
CANARY_PERIOD_S = 60
# Retention of logs: long enough to look into an incident of last month; the audit log has `cloud.audit_days`.
LOG_DAYS = 30
# An object that was overwritten or deleted can be restored for as long as the logs say who did it.
DELETED_DAYS = 30
# Servers that are never Spot instances: robots have one place to go when AWS takes all others back.
ON_DEMAND_SERVERS = 1
# Size of the volume of a server: Debian, the environment of Python, and the logs of some days.
VOLUME_GB = 8
# Hours without robots after which a deployment is idle: a whole day, so that a night alone parks nothing.
IDLE_HOURS = 24
ENDPOINT_SERVICES = {"monitoring": "monitor", "autoscaling": "scale modifier"}
"""The interface endpoints of the VPC: the service of AWS, and the box of Fig. 2 that uses it.

Without them the agents reach neither the monitor nor the group; S3 has a gateway endpoint, which is free."""
# Field of an event of the schedule: the least number of servers with which the deployment is resumed.
RESUME_FIELD = "min_servers"


def zone_count(settings: PlatformSettings) -> int:
    """Return in how many zones servers and endpoints are; the load balancer always needs two."""
    return 1 if settings.cloud.profile == "small" else 2


def parks_when_idle(settings: PlatformSettings) -> bool:
    """Return whether the deployment ends its servers when nobody has used it for `IDLE_HOURS`.

    A platform for more than trials, which TLS or a schedule shows, does so only if its operator says so.
    """
    if settings.cloud.idle_action == "auto":
        return settings.cloud.allow_insecure and not settings.scaling.schedule.strip()
    return settings.cloud.idle_action == "park"
