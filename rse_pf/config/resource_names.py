"""Names of the resources of a deployment that both the stacks and other programs use.

Constants are the same in every deployment; `ResourceNames` derives the other names from that of the
deployment.  This module imports nothing of the platform and reads no setting.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = [
    "AUDIT_PREFIX",
    "DENY_NAME",
    "DEPLOYMENT_TAG",
    "HEALTH_PATH",
    "JOURNAL_PREFIX",
    "KEYS_NAME",
    "READY_PATH",
    "ROBOTS_NAME",
    "ROBOTS_PATH",
    "ROSBRIDGE_PATH",
    "ROSBRIDGE_PORT",
    "SERVICES_PREFIX",
    "SETTINGS_CONTEXT",
    "STACKS",
    "VERSION_PARAMETER",
    "ResourceNames",
    "toolkit_stack",
]

DEPLOYMENT_TAG = "rse-pf"
"""Key of the tag of every resource; its value is `ResourceNames.prefix`."""
HEALTH_PATH = "/healthz"
"""Health check of the robots' port, without a token: it shows only that robots are served.  Below ``/data``
it is the health check of the data service."""
READY_PATH = "/readyz"
"""Readiness check of the control port by load balancers.  Below ``/data`` it shows whether the store of the
data service answers; agents publish this, and no server is replaced because of it."""
ROBOTS_PATH = "/ws"
"""Path of the robots' WebSocket."""
ROSBRIDGE_PATH = "/rosbridge"
"""Path of rosbridge clients at the load balancer, if ``serving.rosbridge`` is set."""
ROSBRIDGE_PORT = 8768
"""Port of the rosbridge server on a backend server; 9090 of rosbridge_suite is often taken on a robot."""
KEYS_NAME = "keys.json"
"""Name of the object in the artifact bucket that holds the public key set."""
ROBOTS_NAME = "control/robots.json"
"""Name of the object in the artifact bucket that holds the roster of enrolled robots."""
DENY_NAME = "control/deny.json"
"""Name of the object in the artifact bucket that holds the list of refused robots and tokens."""
JOURNAL_PREFIX = "journals"
"""Prefix of the journals of servers in the artifact bucket; each instance has a folder below it."""
SERVICES_PREFIX = "services"
"""Prefix of the published services in the artifact bucket: their list and their archives."""
VERSION_PARAMETER = "ServersVersion"
"""Parameter of the backend stack that holds the version of the launch template that servers run."""
AUDIT_PREFIX = "audit"
"""Prefix of the pieces of audit logs in their bucket."""
STACKS = ("Network", "Data", "Backend", "Serverless", "Observability")
"""The boxes that are stacks, in an order in which they can be deployed."""

SETTINGS_CONTEXT = "rse-pf:settings"
"""Key of the CDK's context that names the file of settings, if that is not cdk.json."""


_DEFAULT_QUALIFIER, _DEFAULT_TOOLKIT = "hnb659fds", "CDKToolkit"


def toolkit_stack(qualifier: str) -> str:
    """Return the name of the stack that the CDK's bootstrap with *qualifier* makes.

    The CDK's own name belongs to the CDK's own qualifier: a bootstrap under it with another one would delete
    the roles by which the other applications of the account deploy.
    """
    return _DEFAULT_TOOLKIT if qualifier == _DEFAULT_QUALIFIER else f"{_DEFAULT_TOOLKIT}-{qualifier}"


@dataclass(frozen=True, slots=True)
class ResourceNames:
    """The names in AWS of one deployment; *deployment* is ``cloud.name``, empty for the only one.

    No name of one deployment is a name of another; therefore none may be called ``jobs`` or ``...-jobs``.
    """

    deployment: str = ""

    @property
    def prefix(self) -> str:
        """Return what the names of groups and hooks begin with, and the tag's value: ``rse-pf-lab``."""
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

    @property
    def firewall(self) -> str:
        """Return the name of the metrics of the web firewall."""
        return f"{self.prefix}-waf"

    @property
    def function(self) -> str:
        """Return the name of the function that computes poses."""
        return f"{self.prefix}-pnp"

    @property
    def canary(self) -> str:
        """Return the name of the function that asks for a known pose, and of its robot."""
        return f"{self.prefix}-canary"

    @property
    def budget(self) -> str:
        """Return the name of the budget."""
        return f"{self.prefix}-budget"

    @property
    def parked(self) -> str:
        """Return the name of the SSM parameter that exists while the deployment is parked."""
        return self.parameter("parked")

    def stack(self, box: str) -> str:
        """Return the name of the stack *box*, such as ``RsePf-lab-Backend``."""
        return f"{self.stack_prefix}{box}"

    def owns_stack(self, name: str) -> bool:
        """Return whether *name* is of a stack, or of what CloudFormation named after one, of this deployment.

        A box begins with a capital letter and a deployment does not: RsePf-Data is none of ``lab``.
        """
        rest = name.removeprefix(self.stack_prefix)
        return rest != name and rest[:1].isupper()

    @property
    def alarm_prefix(self) -> str:
        """Return what the names of alarms begin with; the slash keeps those of other deployments apart."""
        return f"{self.prefix}/"

    def alarm(self, name: str) -> str:
        """Return the name of an alarm, such as ``rse-pf-lab/busy``."""
        return f"{self.alarm_prefix}{name}"

    def parameter(self, path: str) -> str:
        """Return the name of an SSM parameter, such as ``/rse-pf-lab/network/vpc``."""
        return f"/{self.prefix}/{path}"
