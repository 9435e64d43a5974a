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
"""Path of the health check of the robots' port, which needs no token; it shows only whether robots can
connect.  Below ``/data`` it is the health check of the data service."""
READY_PATH = "/readyz"
"""Path of the readiness check of the control port, which load balancers request.  Below ``/data`` it shows
whether the object store of the data service answers; agents publish this as a metric, and no server is
replaced because of it."""
ROBOTS_PATH = "/ws"
"""Path of the robots' WebSocket."""
ROSBRIDGE_PATH = "/rosbridge"
"""Path at the load balancer to which rosbridge clients connect, if ``serving.rosbridge`` is set."""
ROSBRIDGE_PORT = 8768
"""Port of the rosbridge server on a backend server, and the default of ``rse-pf rosbridge``, which may run on
a robot.  It is not 9090, because rosbridge_suite often uses that port on robots."""
KEYS_NAME = "keys.json"
"""Name of the object in the artifact bucket that holds the public key set."""
ROBOTS_NAME = "control/robots.json"
"""Name of the object in the artifact bucket that holds the roster of enrolled robots."""
DENY_NAME = "control/deny.json"
"""Name of the object in the artifact bucket that holds the list of refused robots and tokens."""
JOURNAL_PREFIX = "journals"
"""Prefix of the journals (logs) of servers in the artifact bucket; each instance has a folder below it."""
SERVICES_PREFIX = "services"
"""Prefix of the published services in the artifact bucket: their list and their archives."""
VERSION_PARAMETER = "ServersVersion"
"""Parameter of the backend stack that holds the version of the launch template that servers run."""
AUDIT_PREFIX = "audit"
"""Prefix of the objects that hold audit logs in their bucket."""
STACKS = ("Network", "Data", "Backend", "Serverless", "Observability")
"""The CloudFormation stacks of a deployment without their prefix, in an order in which they can be
deployed."""

SETTINGS_CONTEXT = "rse-pf:settings"
"""Key of the CDK's context whose value is the path of the settings file, if that is not cdk.json."""

# Qualifier with which ``cdk bootstrap`` prepares an account if no other is given.
_DEFAULT_QUALIFIER = "hnb659fds"
# Name of the stack that ``cdk bootstrap`` makes with this qualifier.
_DEFAULT_TOOLKIT = "CDKToolkit"


def toolkit_stack(qualifier: str) -> str:
    """Return the name of the CloudFormation stack that ``cdk bootstrap`` makes for *qualifier*.

    It is ``CDKToolkit`` for the CDK's default qualifier only, else ``CDKToolkit-QUALIFIER``.  A bootstrap of
    ``CDKToolkit`` with another qualifier would delete the roles with which other applications of the account
    are deployed.
    """
    return _DEFAULT_TOOLKIT if qualifier == _DEFAULT_QUALIFIER else f"{_DEFAULT_TOOLKIT}-{qualifier}"


@dataclass(frozen=True, slots=True)
class ResourceNames:
    """The names of the AWS resources of one deployment; *deployment* is ``cloud.name``, which may be empty.

    The resources of two deployments never have the same name.
    """

    deployment: str = ""

    @property
    def prefix(self) -> str:
        """Return the beginning of the names of resources, and the value of their tag, such as ``rse-pf-lab``.

        It is ``rse-pf`` for the deployment without a name.
        """
        return f"rse-pf-{self.deployment}" if self.deployment else "rse-pf"

    @property
    def stack_prefix(self) -> str:
        """Return the beginning of the names of the stacks, such as ``RsePf-lab-``."""
        return f"RsePf-{self.deployment}-" if self.deployment else "RsePf-"

    @property
    def group(self) -> str:
        """Return the name of the Auto Scaling group, which an instance knows without a request."""
        return self.prefix

    @property
    def drain_hook(self) -> str:
        """Return the name of the lifecycle hook that an instance completes when its robots have left."""
        return f"{self.prefix}-drain"

    @property
    def launch_hook(self) -> str:
        """Return the name of the lifecycle hook that an instance completes when it can serve robots."""
        return f"{self.prefix}-launch"

    @property
    def dashboard(self) -> str:
        """Return the name of the CloudWatch dashboard."""
        return self.prefix

    @property
    def firewall(self) -> str:
        """Return the name of the metrics of the web firewall."""
        return f"{self.prefix}-waf"

    @property
    def function(self) -> str:
        """Return the name of the Lambda function of the serverless PnP."""
        return f"{self.prefix}-pnp"

    @property
    def canary(self) -> str:
        """Return the name of the canary: of its Lambda function, and of the robot as which it connects."""
        return f"{self.prefix}-canary"

    @property
    def budget(self) -> str:
        """Return the name of the AWS budget."""
        return f"{self.prefix}-budget"

    @property
    def parked(self) -> str:
        """Return the name of the SSM parameter that exists while the deployment is parked."""
        return self.parameter("parked")

    def stack(self, box: str) -> str:
        """Return the name of the stack *box*, one of `STACKS`, such as ``RsePf-lab-Backend``."""
        return f"{self.stack_prefix}{box}"

    def owns_stack(self, name: str) -> bool:
        """Return whether *name* is a stack of this deployment, or a resource that is named after a stack.

        After `stack_prefix` the name of a stack begins with a capital letter, which the name of a deployment
        does not: ``RsePf-lab-Data`` belongs to the deployment ``lab``, not to the one without a name.
        """
        rest = name.removeprefix(self.stack_prefix)
        return rest != name and rest[:1].isupper()

    @property
    def alarm_prefix(self) -> str:
        """Return the beginning of the names of this deployment's alarms, such as ``rse-pf-lab/``.

        It ends with a slash, so that it is no beginning of an alarm name of another deployment.
        """
        return f"{self.prefix}/"

    def alarm(self, name: str) -> str:
        """Return the name of an alarm, such as ``rse-pf-lab/busy``."""
        return f"{self.alarm_prefix}{name}"

    def parameter(self, path: str) -> str:
        """Return the name of an SSM parameter, such as ``/rse-pf-lab/network/vpc``."""
        return f"/{self.prefix}/{path}"
