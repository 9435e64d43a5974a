"""The idle timer: each hour a function parks the deployment if nobody has used it for ``idle_hours``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import cast

import aws_cdk as cdk
from aws_cdk import aws_events as events
from aws_cdk import aws_events_targets as targets
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_logs as logs
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import DEPLOYMENT_TAG, ResourceNames
from stacks.assets import staged
from stacks.findings import acknowledge
from stacks.permissions import BY_AWS, LOG_ACTIONS, allow, explain

__all__ = ["IdleTimer"]

_TIMEOUT_S = 60
_MB = 256
_LIFECYCLE = "rse_pf/aws/lifecycle"


class IdleTimer(Construct):
    """Function, its log and its schedule."""

    def __init__(
        self, scope: Construct, construct_id: str, *, settings: PlatformSettings, assets: Path, topic: str
    ) -> None:
        super().__init__(scope, construct_id)
        names = ResourceNames(settings.cloud.name)
        log = logs.LogGroup(self, "Log", removal_policy=cdk.RemovalPolicy.DESTROY)
        cast("logs.CfnLogGroup", log.node.default_child).retention_in_days = settings.cloud.log_days
        role = iam.Role(self, "Role", assumed_by=iam.ServicePrincipal("lambda.amazonaws.com"))
        log.grant_write(role)
        explain(role, LOG_ACTIONS, used_by=f"{BY_AWS}Lambda writes what the function prints")
        self._allow(role, names, topic)
        with tempfile.TemporaryDirectory() as folder:
            code = lambda_.Code.from_asset(str(staged(assets, "lambda", settings, Path(folder))))
            function = lambda_.Function(
                self, "Function", runtime=lambda_.Runtime.PYTHON_3_13,
                architecture=lambda_.Architecture.X86_64, code=code,
                handler=f"{_LIFECYCLE.replace('/', '.')}.idle.handler", role=role,
                log_group=log, memory_size=_MB, timeout=cdk.Duration.seconds(_TIMEOUT_S),
                environment={"RSE_PF_TOPIC": topic},
            )  # fmt: skip
        acknowledge(function, "the newest runtime with wheels of every package in the lock", "L1")
        events.Rule(
            self, "EachHour", schedule=events.Schedule.rate(cdk.Duration.hours(1)),
            targets=[targets.LambdaFunction(function, retry_attempts=1)],
        )  # fmt: skip

    def _allow(self, role: iam.Role, names: ResourceNames, topic: str) -> None:
        """Allow to read, and to end servers; nothing can be deleted."""
        stack = cdk.Stack.of(self)
        why = "reading knows no resources"
        allow(
            role, ["cloudwatch:GetMetricData"], ["*"], used_by=f"{_LIFECYCLE}/idle.py:_read_hours", why=why
        )  # fmt: skip
        allow(
            role, ["autoscaling:DescribeAutoScalingGroups"], ["*"],
            used_by=f"{_LIFECYCLE}/deployment.py:read_sizes", why=why,
        )  # fmt: skip
        groups = stack.format_arn(
            service="autoscaling", resource="autoScalingGroup",
            resource_name=f"*:autoScalingGroupName/{names.prefix}*",
            arn_format=cdk.ArnFormat.COLON_RESOURCE_NAME,
        )  # fmt: skip
        allow(
            role, ["autoscaling:SuspendProcesses", "autoscaling:UpdateAutoScalingGroup"], [groups],
            used_by=f"{_LIFECYCLE}/parking.py:empty_group",
            conditions={"StringEquals": {f"aws:ResourceTag/{DEPLOYMENT_TAG}": names.prefix}},
            why="the ARN of a group holds an id that only AWS knows; the tag is of this deployment",
        )  # fmt: skip
        allow(
            role, ["cloudwatch:DescribeAlarms"], ["*"],
            used_by=f"{_LIFECYCLE}/parking.py:alarms_of_deployment", why=why,
        )  # fmt: skip
        alarms = stack.format_arn(
            service="cloudwatch", resource="alarm", resource_name=f"{names.alarm_prefix}*",
            arn_format=cdk.ArnFormat.COLON_RESOURCE_NAME,
        )  # fmt: skip
        allow(
            role, ["cloudwatch:DisableAlarmActions"], [alarms],
            used_by=f"{_LIFECYCLE}/parking.py:silence_alarms", why="all alarms of this deployment",
        )  # fmt: skip
        note = stack.format_arn(
            service="ssm", resource="parameter", resource_name=names.parked.removeprefix("/")
        )
        allow(role, ["ssm:GetParameter"], [note], used_by=f"{_LIFECYCLE}/deployment.py:read_note")
        allow(role, ["ssm:PutParameter"], [note], used_by=f"{_LIFECYCLE}/parking.py:write_note")
        allow(role, ["sns:Publish"], [topic], used_by=f"{_LIFECYCLE}/idle.py:park_if_idle")
