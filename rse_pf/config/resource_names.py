"""What things of a deployment are called by more than one side: by the stacks, and by who looks for them.

Promises to import nothing, and to hold no setting: a name here is the same in every deployment.
"""

from __future__ import annotations

__all__ = [
    "AUDIT_PREFIX",
    "DATA_STACK",
    "DENY_NAME",
    "GROUP",
    "HEALTH_PATH",
    "HOOK",
    "KEYS_NAME",
    "READY_PATH",
    "ROBOTS_NAME",
    "ROSBRIDGE_PATH",
]

GROUP = "rse-pf"
"""Of the Auto Scaling group; fixed, so that an instance knows it before the group exists."""
HOOK = "rse-pf-drain"
"""Of the lifecycle hook that an instance completes when its robots are gone."""
HEALTH_PATH = "/healthz"
"""At the robots' port; it tells everybody that robots are served, and nothing else."""
READY_PATH = "/readyz"
"""At the control port, and below ``/data`` at the data service; load balancers ask it."""
ROSBRIDGE_PATH = "/rosbridge"
"""At the robots' port, where ``serving.rosbridge`` is on."""
DATA_STACK = "RsePf-Data"
KEYS_NAME = "keys.json"
"""Of the public key set in the artifact bucket."""
ROBOTS_NAME = "control/robots.json"
"""Of the roster beside it: who is enrolled."""
DENY_NAME = "control/deny.json"
"""Of the deny-list beside it: who is refused."""
AUDIT_PREFIX = "audit"
"""Of the pieces of audit logs in their bucket."""
