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

# Memory of the Lambda function of the serverless PnP, in MB: the least with which AWS gives a function one
# whole vCPU.  A command uses one.
LAMBDA_MEMORY_MB = 1769
# Memory of the canary's Lambda function, in MB: it comes with a third of a vCPU, with which a cold start and
# one pose fit into the function's time limit.
CANARY_MB = 512
# Seconds between two calls of the canary: one call in each period of its alarm.
CANARY_PERIOD_S = 60
# Days for which logs are kept: long enough to investigate an incident of the last month.  The audit log is
# kept for `cloud.audit_days` instead.
LOG_DAYS = 30
# Days for which an object of S3 that was overwritten or deleted can be restored: as long as logs are kept,
# which show who did it.
DELETED_DAYS = 30
# Servers that are never Spot instances: robots can connect to one server when AWS reclaims all others.
ON_DEMAND_SERVERS = 1
# Size of the disk volume of a server, in GB: Debian, the Python environment, and the logs of some days.
VOLUME_GB = 8
# Hours without robots and commands after which a deployment is idle: a day, so that a night parks nothing.
IDLE_HOURS = 24
ENDPOINT_SERVICES = {"monitoring": "monitor", "autoscaling": "scale modifier"}
"""The interface endpoints of the VPC: the AWS service, and the component of the paper's Fig. 2 that uses it.

Without these endpoints the agents on the servers reach neither CloudWatch nor the Auto Scaling group.  S3 has
a gateway endpoint instead, which is free."""
# Field of an event that resumes a parked deployment by schedule: its new minimum number of servers.
RESUME_FIELD = "min_servers"


def zone_count(settings: PlatformSettings) -> int:
    """Return the number of availability zones of servers and VPC endpoints: 1 in the profile small, else 2.

    The load balancer always has two.
    """
    return 1 if settings.cloud.profile == "small" else 2


def parks_when_idle(settings: PlatformSettings) -> bool:
    """Return whether the deployment terminates its servers when nobody has used it for `IDLE_HOURS`.

    With ``cloud.idle_action`` "auto" only a deployment for trials does: one without TLS
    (``cloud.allow_insecure``) and without ``scaling.schedule``.
    """
    if settings.cloud.idle_action == "auto":
        return settings.cloud.allow_insecure and not settings.scaling.schedule.strip()
    return settings.cloud.idle_action == "park"
