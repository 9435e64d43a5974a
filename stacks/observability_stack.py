"""Monitoring for the operator: one dashboard, with the paper's Fig. 8, and alarms with a runbook each.

The alarms here notify people; they do not scale the group.
"""

from __future__ import annotations

import aws_cdk as cdk
from aws_cdk import aws_cloudwatch as cloudwatch
from aws_cdk import aws_cloudwatch_actions as actions
from aws_cdk import aws_elasticloadbalancingv2 as elbv2
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.scaling.alarms import NAMESPACE
from stacks.backend_stack import BackendStack

__all__ = ["ObservabilityStack"]

_WIDTH = 12
_PERIODS = 3


class ObservabilityStack(cdk.Stack):
    """Dashboard and operator alarms."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: PlatformSettings,
        backend: BackendStack,
        env: cdk.Environment,
    ) -> None:
        super().__init__(scope, construct_id, env=env)
        self._period = cdk.Duration.seconds(settings.scaling.period_s)
        group = {"AutoScalingGroupName": backend.servers.group.auto_scaling_group_name}
        robots = backend.balancer.targets["robots"]
        unhealthy = robots.metrics.unhealthy_host_count(period=self._period)
        errors = robots.metrics.http_code_target(elbv2.HttpCodeTarget.TARGET_5XX_COUNT, period=self._period)
        rows = {
            "CPU (Fig. 8)": [self._metric("AWS/EC2", "CPUUtilization", "Average", group)],
            "Bandwidth (Fig. 8)": [
                self._metric("AWS/EC2", name, "Sum", group) for name in ("NetworkIn", "NetworkOut")
            ],
            "Servers": [robots.metrics.healthy_host_count(period=self._period), unhealthy],
            "Robots": [self._metric(NAMESPACE, "Robots", "Sum", group)],
            "Requests": [self._metric(NAMESPACE, "Requests", "Sum", group)],
            "Queue": [self._metric(NAMESPACE, "QueueMs", "Maximum", group)],
            "Answers, p95": [self._metric(NAMESPACE, "AnswerMs", "p95", group)],
        }
        board = cloudwatch.Dashboard(self, "Dashboard", dashboard_name="rse-pf")
        board.add_widgets(
            *(
                cloudwatch.GraphWidget(title=title, left=series, width=_WIDTH)
                for title, series in rows.items()
            )
        )
        for name, metric, threshold in (("unhealthy", unhealthy, 1), ("errors", errors, 1)):
            alarm = cloudwatch.Alarm(
                self, name.capitalize(), alarm_name=f"rse-pf-{name}", metric=metric, threshold=threshold,
                evaluation_periods=_PERIODS,
                alarm_description=f"runbook: docs/operations.md#{name}",
                treat_missing_data=cloudwatch.TreatMissingData.NOT_BREACHING,
            )  # fmt: skip
            alarm.add_alarm_action(actions.SnsAction(backend.topic))

    def _metric(
        self, namespace: str, name: str, statistic: str, dimensions: dict[str, str]
    ) -> cloudwatch.Metric:
        return cloudwatch.Metric(
            namespace=namespace, metric_name=name, statistic=statistic, period=self._period,
            dimensions_map=dimensions,
        )  # fmt: skip
