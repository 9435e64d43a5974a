"""The function that parks the deployment if nobody used it for `IDLE_HOURS`, and resumes it by schedule.

It is called each hour if ``cloud.idle_action`` says so, and at those entries of ``scaling.schedule`` that do
not lower the number of servers.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import aws_cdk as cdk
from aws_cdk import aws_events as events
from aws_cdk import aws_events_targets as targets
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_logs as logs
from aws_cdk import aws_scheduler as scheduler
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import LOG_DAYS, RESUME_FIELD, parks_when_idle
from rse_pf.config.resource_names import DEPLOYMENT_TAG, ResourceNames
from rse_pf.config.schedule import DAYS, ScheduleEntry, parse_schedule, resuming
from stacks.assets import staged
from stacks.findings import acknowledge
from stacks.permissions import BY_AWS, LOG_ACTIONS, allow, explain

__all__ = ["IdleTimer"]

# Time limit of an execution of the function, in seconds: it makes about a dozen calls to AWS.
_TIMEOUT_S = 60
# Memory of the function in MB; it only makes calls to AWS.
_MEMORY_MB = 256
_LIFECYCLE = "rse_pf/aws/lifecycle"
# Number of times that a failed call which resumes the deployment is repeated.
_RETRIES = 5
# Seconds within which a failed call which resumes the deployment is repeated: an hour late is better than a
# working day without servers.
_RETRY_WITHIN_S = 3600


class IdleTimer(Construct):
    """The function, its log group, its role, and the rule and schedules that call it.

    *topic* is the ARN of the SNS topic that is notified when the deployment is parked or resumed.
    """

    def __init__(
        self, scope: Construct, construct_id: str, *, settings: PlatformSettings, assets: Path, topic: str
    ) -> None:
        super().__init__(scope, construct_id)
        names = ResourceNames(settings.cloud.name)
        log = logs.LogGroup(self, "Log", removal_policy=cdk.RemovalPolicy.DESTROY)
        cast("logs.CfnLogGroup", log.node.default_child).retention_in_days = LOG_DAYS
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
                log_group=log, memory_size=_MEMORY_MB, timeout=cdk.Duration.seconds(_TIMEOUT_S),
                environment={"RSE_PF_TOPIC": topic},
            )  # fmt: skip
        acknowledge(function, "the newest runtime with wheels of every package in the lock", "L1")
        if parks_when_idle(settings):
            events.Rule(
                self, "EachHour", schedule=events.Schedule.rate(cdk.Duration.hours(1)),
                targets=[targets.LambdaFunction(function, retry_attempts=1)],
            )  # fmt: skip
        entries = resuming(parse_schedule(settings.scaling.schedule))
        if entries:
            self._call_at_entries(function, entries, settings)

    def _call_at_entries(
        self, function: lambda_.Function, entries: Sequence[ScheduleEntry], settings: PlatformSettings
    ) -> None:
        """Call *function* at each of *entries*, because a parked group carries out no scheduled actions."""
        account = cdk.Stack.of(self).account
        caller = iam.Role(
            self, "Caller", assumed_by=iam.ServicePrincipal(
                "scheduler.amazonaws.com", conditions={"StringEquals": {"aws:SourceAccount": account}}
            ),
        )  # fmt: skip
        allow(
            caller, ["lambda:InvokeFunction"], [function.function_arn],
            used_by=f"{BY_AWS}EventBridge Scheduler calls the function",
        )  # fmt: skip
        for number, entry in enumerate(entries):
            days = ",".join(DAYS[day].upper() for day in entry.days)
            scheduler.CfnSchedule(
                self, f"Resume{number}", schedule_expression_timezone=settings.scaling.time_zone,
                schedule_expression=f"cron({entry.minute} {entry.hour} ? * {days} *)",
                flexible_time_window=scheduler.CfnSchedule.FlexibleTimeWindowProperty(mode="OFF"),
                target=scheduler.CfnSchedule.TargetProperty(
                    arn=function.function_arn, role_arn=caller.role_arn,
                    input=json.dumps({RESUME_FIELD: entry.min_servers}),
                    retry_policy=scheduler.CfnSchedule.RetryPolicyProperty(
                        maximum_retry_attempts=_RETRIES, maximum_event_age_in_seconds=_RETRY_WITHIN_S
                    ),
                ),
            ).node.add_dependency(caller)  # fmt: skip

    def _allow(self, role: iam.Role, names: ResourceNames, topic: str) -> None:
        """Allow *role* to read metrics, change sizes of groups, switch alarms, and write the note."""
        stack = cdk.Stack.of(self)
        why = "these actions take no resources"
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
            role,
            [
                "autoscaling:SuspendProcesses", "autoscaling:ResumeProcesses",
                "autoscaling:UpdateAutoScalingGroup",
            ],
            [groups],
            used_by=(f"{_LIFECYCLE}/parking.py:empty_group", f"{_LIFECYCLE}/parking.py:fill_groups"),
            conditions={"StringEquals": {f"aws:ResourceTag/{DEPLOYMENT_TAG}": names.prefix}},
            why="the ARN of a group holds an id that AWS assigns; the tag is of this deployment",
        )  # fmt: skip
        allow(
            role, ["cloudwatch:DescribeAlarms"], ["*"],
            used_by=f"{_LIFECYCLE}/parking.py:_alarms_of_deployment", why=why,
        )  # fmt: skip
        alarms = stack.format_arn(
            service="cloudwatch", resource="alarm", resource_name=f"{names.alarm_prefix}*",
            arn_format=cdk.ArnFormat.COLON_RESOURCE_NAME,
        )  # fmt: skip
        allow(
            role, ["cloudwatch:DisableAlarmActions", "cloudwatch:EnableAlarmActions"], [alarms],
            used_by=(f"{_LIFECYCLE}/parking.py:silence_alarms", f"{_LIFECYCLE}/parking.py:enable_alarms"),
            why="all alarms of this deployment",
        )  # fmt: skip
        note = stack.format_arn(
            service="ssm", resource="parameter", resource_name=names.parked.removeprefix("/")
        )
        allow(role, ["ssm:GetParameter"], [note], used_by=f"{_LIFECYCLE}/deployment.py:read_note")
        allow(role, ["ssm:PutParameter"], [note], used_by=f"{_LIFECYCLE}/parking.py:write_note")
        allow(role, ["ssm:DeleteParameter"], [note], used_by=f"{_LIFECYCLE}/parking.py:delete_note")
        allow(role, ["sns:Publish"], [topic], used_by=f"{_LIFECYCLE}/idle.py:park_if_idle")
