"""What things of a deployment are called by more than one side: by the stacks, and by who looks for them.

Promises to import nothing, and to hold no setting: a name here is the same in every deployment.
"""

from __future__ import annotations

from dataclasses import dataclass

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
    "ResourceNames",
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


@dataclass(frozen=True, slots=True)
class ResourceNames:
    """The names in AWS of one deployment; *deployment* is ``cloud.name``, empty for the only one."""

    deployment: str = ""

    @property
    def prefix(self) -> str:
        """Return what the names of alarms, groups and hooks begin with, such as ``rse-pf-lab``."""
        return f"rse-pf-{self.deployment}" if self.deployment else "rse-pf"

    @property
    def stack_prefix(self) -> str:
        """Return what the names of the stacks begin with, such as ``RsePf-lab-``."""
        return f"RsePf-{self.deployment}-" if self.deployment else "RsePf-"

    @property
    def group(self) -> str:
        """Return the name of the Auto Scaling group; fixed, so that an instance knows it beforehand."""
        return self.prefix

    @property
    def drain_hook(self) -> str:
        """Return the name of the lifecycle hook that an instance completes when its robots are gone."""
        return f"{self.prefix}-drain"

    @property
    def launch_hook(self) -> str:
        """Return the name of the lifecycle hook that an instance completes when it is ready."""
        return f"{self.prefix}-launch"

    @property
    def dashboard(self) -> str:
        """Return the name of the dashboard."""
        return self.prefix

    def stack(self, box: str) -> str:
        """Return the name of the stack *box*, such as ``RsePf-lab-Backend``."""
        return f"{self.stack_prefix}{box}"

    def alarm(self, name: str) -> str:
        """Return the name of an alarm, such as ``rse-pf-lab-busy``."""
        return f"{self.prefix}-{name}"

    def parameter(self, path: str) -> str:
        """Return the name of an SSM parameter, such as ``/rse-pf-lab/network/vpc``."""
        return f"/{self.prefix}/{path}"
