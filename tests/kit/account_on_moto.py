"""A small deployment on moto: five stacks with one resource of each kind that the life cycle touches.

The real templates are created on moto by tests/stacks; here they would cost seconds for each of a hundred
ends of a command.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from rse_pf.aws.account import Account
from rse_pf.aws.clients import make_client
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames

NAMES = ResourceNames()
READS = ("describe_", "get_", "list_", "can_")


class Killed(BaseException):
    """The process was ended; nothing catches it."""


class Killer:
    """Ends the process before the change number *at*; counts changes."""

    def __init__(self, at: int | None = None) -> None:
        self.at = at
        self.count = 0

    def __call__(self) -> None:
        self.count += 1
        if self.count == self.at:
            raise Killed


class Client:
    """A client that asks the killer before each call that changes something."""

    def __init__(self, real: Any, killer: Killer) -> None:
        self._real, self._killer = real, killer

    def __getattr__(self, method: str) -> Any:
        own = {"update_termination_protection": self._unprotect, "delete_stack": self._delete_stack}
        if method in own:
            return own[method]
        real = getattr(self._real, method)
        if method.startswith(READS):
            return real

        def call(**arguments: Any) -> Any:
            self._killer()
            return real(**arguments)

        return call

    def _unprotect(self, *, StackName: str, EnableTerminationProtection: bool) -> dict[str, str]:
        """Do what moto lacks."""
        self._killer()
        self._stack(StackName).enable_termination_protection = EnableTerminationProtection
        return {"StackId": StackName}

    def _delete_stack(self, *, StackName: str) -> dict[str, str]:
        """Refuse what AWS refuses, and moto does not."""
        from botocore.exceptions import ClientError

        self._killer()
        if self._stack(StackName).enable_termination_protection:
            raise ClientError({"Error": {"Code": "ValidationError"}}, "DeleteStack")
        return dict(self._real.delete_stack(StackName=StackName))

    def _stack(self, name: str) -> Any:
        from moto.cloudformation.models import cloudformation_backends

        return cloudformation_backends["123456789012"][self._real.meta.region_name].get_stack(name)


def account_of(region: str, killer: Killer) -> Account:
    """Return an account whose changes *killer* may prevent."""
    return Account(region, lambda name, at: Client(make_client(name, at), killer))


class Formation:
    """Tools that create stacks on moto, in place of the CDK's command line."""

    has_packages = True

    def __init__(self, region: str, killer: Killer) -> None:
        self._region, self._killer = region, killer
        self.deployed: list[str] = []

    def build(self) -> None:
        self._killer()

    def bootstrap(self) -> None:
        self._killer()
        make_client("ssm", self._region).put_parameter(
            Name="/cdk-bootstrap/hnb659fds/version", Value="30", Type="String", Overwrite=True
        )
        self._killer()

    def deploy(self, stack: str) -> None:
        self._killer()
        formation = make_client("cloudformation", self._region)
        standing = [each["StackName"] for each in formation.list_stacks()["StackSummaries"]
                    if each["StackStatus"] != "DELETE_COMPLETE"]  # fmt: skip
        self.deployed.append(stack)
        box = stack.removeprefix(NAMES.stack_prefix)
        if stack not in standing:
            formation.create_stack(
                StackName=stack, TemplateBody=json.dumps(_template(box, self._region)),
                EnableTerminationProtection=box == "Data", Tags=[],
            )  # fmt: skip
        if box == "Backend" and stack not in standing:
            put_alarm(self._region)
        self._killer()


def put_alarm(region: str) -> None:
    """Make the alarm that moto does not make from a template."""
    make_client("cloudwatch", region).put_metric_alarm(
        AlarmName=NAMES.alarm("busy"), MetricName="m", Namespace="n", Statistic="Sum", Period=60,
        Threshold=1, EvaluationPeriods=1, ComparisonOperator="GreaterThanThreshold", ActionsEnabled=True,
    )  # fmt: skip


def _template(box: str, region: str) -> dict[str, Any]:
    tags = [{"Key": "rse-pf", "Value": NAMES.prefix}]
    made: Callable[[str, dict[str, Any]], dict[str, Any]] = lambda kind, with_: {  # noqa: E731
        "Type": kind,
        "Properties": with_,
    }
    log = {"Log": made("AWS::Logs::LogGroup", {"LogGroupName": f"{NAMES.stack_prefix}{box}-Log"})}
    if box == "Data":
        kept = {"DeletionPolicy": "Retain", "UpdateReplacePolicy": "Retain"}
        return {
            "Resources": {
                name: {
                    **made("AWS::S3::Bucket", {"BucketName": f"{name.lower()}-of-rse-pf", "Tags": tags}),
                    **kept,
                }
                for name in ("Maps", "Artifacts", "AuditLogs", "AccessLogs")
            }
        }
    if box != "Backend":
        return {"Resources": log}
    template = {"LaunchTemplateData": {"ImageId": "ami-12345678", "InstanceType": "c7i.large"}}
    group = {
        "AutoScalingGroupName": NAMES.group, "MinSize": "2", "MaxSize": "10",
        "AvailabilityZones": [f"{region}a"],
        "LaunchTemplate": {"LaunchTemplateId": {"Ref": "Template"}, "Version": "1"},
        "Tags": [{**tags[0], "PropagateAtLaunch": True}], "TargetGroupARNs": [{"Ref": "Targets"}],
    }  # fmt: skip
    (vpc,) = make_client("ec2", region).describe_vpcs()["Vpcs"]
    targets = {"Port": 80, "Protocol": "HTTP", "VpcId": vpc["VpcId"], "TargetType": "instance"}
    return {
        "Resources": {
            **log,
            "Targets": made("AWS::ElasticLoadBalancingV2::TargetGroup", targets),
            "Template": made("AWS::EC2::LaunchTemplate", template),
            "Group": made("AWS::AutoScaling::AutoScalingGroup", group),
        },
        "Outputs": {"Url": {"Value": "ws://robots.example.org/ws"}},
    }


SETTINGS = PlatformSettings()
