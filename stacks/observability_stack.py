"""Monitoring for the operator: one dashboard, with the paper's Fig. 8, and alarms with a runbook each.

The alarms here notify people; they do not scale the group.
"""

from __future__ import annotations

import aws_cdk as cdk
from aws_cdk import aws_cloudwatch as cloudwatch
from aws_cdk import aws_cloudwatch_actions as actions
from aws_cdk import aws_sns as sns
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.scaling.alarms import NAMESPACE
from stacks.values import read

__all__ = ["ObservabilityStack"]

_WIDTH = 12
_ALB = "AWS/ApplicationELB"
_PERIODS = 3


class ObservabilityStack(cdk.Stack):
    """Dashboard and operator alarms; it reads the ARNs that the backend stack provides."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: PlatformSettings,
        env: cdk.Environment,
        synthesizer: cdk.IStackSynthesizer | None = None,
    ) -> None:
        super().__init__(scope, construct_id, env=env, synthesizer=synthesizer)
        names = ResourceNames(settings.cloud.name)
        self._period = cdk.Duration.seconds(settings.scaling.period_s)
        group = {"AutoScalingGroupName": names.group}
        robots = {
            "LoadBalancer": _after(read(self, names, "backend/balancer"), ":loadbalancer/"),
            "TargetGroup": cdk.Fn.select(5, cdk.Fn.split(":", read(self, names, "backend/robots"))),
        }
        topic = sns.Topic.from_topic_arn(self, "Events", read(self, names, "backend/topic"))
        unhealthy = self._metric(_ALB, "UnHealthyHostCount", "Average", robots)
        errors = self._metric(_ALB, "HTTPCode_Target_5XX_Count", "Sum", robots)
        rows = {
            "CPU (Fig. 8)": [self._metric("AWS/EC2", "CPUUtilization", "Average", group)],
            "Bandwidth (Fig. 8)": [
                self._metric("AWS/EC2", name, "Sum", group) for name in ("NetworkIn", "NetworkOut")
            ],
            "Servers": [self._metric(_ALB, "HealthyHostCount", "Average", robots), unhealthy],
            "Robots": [self._metric(NAMESPACE, "Robots", "Sum", group)],
            "Requests": [self._metric(NAMESPACE, "Requests", "Sum", group)],
            "Queue": [self._metric(NAMESPACE, "QueueMs", "Maximum", group)],
            "Answers, p95": [self._metric(NAMESPACE, "AnswerMs", "p95", group)],
        }
        board = cloudwatch.Dashboard(self, "Dashboard", dashboard_name=names.dashboard)
        board.add_widgets(
            *(
                cloudwatch.GraphWidget(title=title, left=series, width=_WIDTH)
                for title, series in rows.items()
            )
        )
        for name, metric, threshold in (("unhealthy", unhealthy, 1), ("errors", errors, 1)):
            alarm = cloudwatch.Alarm(
                self, name.capitalize(), alarm_name=names.alarm(name), metric=metric, threshold=threshold,
                evaluation_periods=_PERIODS,
                alarm_description=f"runbook: docs/operations.md#{name}",
                treat_missing_data=cloudwatch.TreatMissingData.NOT_BREACHING,
            )  # fmt: skip
            alarm.add_alarm_action(actions.SnsAction(topic))

    def _metric(
        self, namespace: str, name: str, statistic: str, dimensions: dict[str, str]
    ) -> cloudwatch.Metric:
        return cloudwatch.Metric(
            namespace=namespace, metric_name=name, statistic=statistic, period=self._period,
            dimensions_map=dimensions,
        )  # fmt: skip


def _after(arn: str, word: str) -> str:
    """Return what follows *word* in an ARN that is known at the deployment."""
    return cdk.Fn.select(1, cdk.Fn.split(word, arn))
