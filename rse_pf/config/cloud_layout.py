"""What a deployment on AWS consists of beyond its settings: what the stacks build, and what a bill counts."""

from __future__ import annotations

from rse_pf.config.settings import PlatformSettings

__all__ = ["CANARY_MB", "CANARY_PERIOD_S", "ENDPOINT_SERVICES", "zone_count"]

CANARY_MB, CANARY_PERIOD_S = 512, 60
"""Memory of the canary's function, and the time between two calls."""
ENDPOINT_SERVICES = {"monitoring": "monitor", "autoscaling": "scale modifier"}
"""The interface endpoints of the VPC: the service of AWS, and the box of Fig. 2 that uses it.

Without them the agents reach neither the monitor nor the group; S3 has a gateway endpoint, which is free."""


def zone_count(settings: PlatformSettings) -> int:
    """Return in how many zones servers and endpoints are; the load balancer always needs two."""
    return 1 if settings.cloud.profile == "small" else 2
