"""The observability stack: a dashboard of the boxes of Fig. 2, alarms with runbooks, canary and budget.

The alarms here notify an operator and do not scale the fleet; `rse_pf.scaling.operator_alarms` defines them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import aws_cdk as cdk
from aws_cdk import aws_budgets as budgets
from aws_cdk import aws_cloudwatch as cloudwatch
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import parks_when_idle
from rse_pf.config.resource_names import ResourceNames
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.scaling.operator_alarms import (
    NATIVE_CRASHES,
    STORE_ERRORS,
    OperatorAlarm,
    Series,
    operator_alarms,
)
from stacks.canary import Canary
from stacks.idle_timer import IdleTimer
from stacks.values import read

__all__ = ["ObservabilityStack"]

# Width of a graph in columns: half of the dashboard's 24 columns.
_GRAPH_WIDTH = 12
# CloudWatch namespaces of AWS's services.
_ALB = "AWS/ApplicationELB"
_EC2 = "AWS/EC2"
_GROUP = "AWS/AutoScaling"
_LAMBDA = "AWS/Lambda"
_S3 = "AWS/S3"
# Percentage of the monthly budget that, once spent, notifies the operator: early enough to act in that month.
_BUDGET_ACTUAL_PERCENT = 80
# Percentage of the monthly budget whose forecast use notifies the operator.
_BUDGET_FORECAST_PERCENT = 100

Dimensions = Mapping[str, str]


class ObservabilityStack(cdk.Stack):
    """The stack with the dashboard, the operator's alarms, canary, idle timer and budget.

    It reads the values that the backend and data stacks provide.
    """

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: PlatformSettings,
        assets: Path,
        env: cdk.Environment,
        synthesizer: cdk.IStackSynthesizer | None = None,
    ) -> None:
        super().__init__(scope, construct_id, env=env, synthesizer=synthesizer)
        names = ResourceNames(settings.cloud.name)
        self._period = cdk.Duration.seconds(settings.scaling.period_s)
        balancer = {"LoadBalancer": _after(read(self, names, "backend/balancer"), ":loadbalancer/")}
        robots = cdk.Fn.select(5, cdk.Fn.split(":", read(self, names, "backend/robots")))
        self._dimensions: dict[str, Dimensions] = {
            "group": {"AutoScalingGroupName": names.group},
            "balancer": balancer,
            "targets": {**balancer, "TargetGroup": robots},
            "firewall": {"WebACL": names.firewall, "Region": settings.cloud.region, "Rule": "ALL"},
            "function": {"FunctionName": names.function},
            "canary": {"FunctionName": names.canary},
            "maps": {"BucketName": read(self, names, "data/maps"), "StorageType": "StandardStorage"},
        }
        topic = read(self, names, "backend/topic")
        self._dashboard(names, settings)
        for alarm in operator_alarms(settings):
            self._alarm(alarm, names, topic)
        if settings.cloud.canary:
            Canary(
                self, "Canary", settings=settings, assets=assets, url=read(self, names, "backend/url")
            )  # fmt: skip
        if parks_when_idle(settings) or settings.scaling.schedule.strip():
            IdleTimer(self, "IdleTimer", settings=settings, assets=assets, topic=topic)
        if settings.cloud.budget_per_month:
            self._budget(names, settings.cloud.budget_per_month, topic)

    def _dashboard(self, names: ResourceNames, settings: PlatformSettings) -> None:
        """Add the dashboard, with a row for each box of Fig. 2 that shows its load and its faults."""
        of = self._metric
        rows: dict[str, dict[str, list[cloudwatch.IMetric]]] = {
            "Firewall": {
                "Requests blocked and allowed": [
                    of("firewall", "AWS/WAFV2", name, "Sum")
                    for name in ("BlockedRequests", "AllowedRequests")
                ],
                "Handshakes that servers refused (4xx)": [
                    of("targets", _ALB, "HTTPCode_Target_4XX_Count", "Sum")
                ],
            },
            "Load balancer": {
                "Robots' connections": [
                    of("balancer", _ALB, name, "Sum")
                    for name in ("ActiveConnectionCount", "NewConnectionCount")
                ],
                "5xx of the balancer and of the servers": [
                    of("balancer", _ALB, "HTTPCode_ELB_5XX_Count", "Sum"),
                    of("targets", _ALB, "HTTPCode_Target_5XX_Count", "Sum"),
                ],
            },
            "Backend servers": {
                "CPU (Fig. 8)": [of("group", _EC2, "CPUUtilization", "Average")],
                "Bandwidth (Fig. 8)": [
                    of("group", _EC2, name, "Sum") for name in ("NetworkIn", "NetworkOut")
                ],
                "Robots and requests": [
                    of("group", NAMESPACE, name, "Sum") for name in ("Robots", "Requests")
                ],
                "Crashes of native code": [of("group", NAMESPACE, NATIVE_CRASHES, "Sum")],
                "Queue, and answers' p95": [
                    of("group", NAMESPACE, "QueueMs", "Maximum"), of("group", NAMESPACE, "AnswerMs", "p95"),
                ],
            },
            "Monitor": {
                "Reports of the agents": [of("group", NAMESPACE, "Robots", "SampleCount")],
                "Serverless PnP": [
                    of("function", _LAMBDA, name, "Sum") for name in ("Invocations", "Errors", "Throttles")
                ],
            },
            "Scale modifier": {
                "Servers wanted and in service": [
                    of("group", _GROUP, name, "Average")
                    for name in ("GroupDesiredCapacity", "GroupInServiceInstances")
                ],
                "Servers healthy and unhealthy": [
                    of("targets", _ALB, "HealthyHostCount", "Minimum"),
                    of("targets", _ALB, "UnHealthyHostCount", "Maximum"),
                ],
            },
            "Data servers": {
                "Objects and maps, bytes": [
                    of("maps", _S3, "BucketSizeBytes", "Average", period=cdk.Duration.days(1))
                ],
                "Failed checks of the bucket": [of("group", NAMESPACE, STORE_ERRORS, "Sum")],
            },
        }  # fmt: skip
        if settings.cloud.canary:
            rows["Monitor"]["Canary"] = [
                of("canary", _LAMBDA, "Duration", "p95"), of("canary", _LAMBDA, "Errors", "Sum"),
            ]  # fmt: skip
        board = cloudwatch.Dashboard(self, "Dashboard", dashboard_name=names.dashboard)
        for box, graphs in rows.items():
            board.add_widgets(cloudwatch.TextWidget(markdown=f"# {box}", width=2 * _GRAPH_WIDTH, height=1))
            board.add_widgets(
                *(
                    cloudwatch.GraphWidget(title=title, left=series, width=_GRAPH_WIDTH)
                    for title, series in graphs.items()
                )
            )

    def _metric(
        self, source: str, namespace: str, name: str, statistic: str, *, period: cdk.Duration | None = None
    ) -> cloudwatch.Metric:
        return cloudwatch.Metric(
            namespace=namespace, metric_name=name, statistic=statistic, period=period or self._period,
            dimensions_map=self._dimensions[source],
        )  # fmt: skip

    def _alarm(self, alarm: OperatorAlarm, names: ResourceNames, topic: str) -> None:
        queries = [
            cloudwatch.CfnAlarm.MetricDataQueryProperty(
                id=series.name, return_data=False,
                metric_stat=cloudwatch.CfnAlarm.MetricStatProperty(
                    period=alarm.period_s, stat=series.statistic, metric=self._series(series)
                ),
            )
            for series in alarm.series
        ]  # fmt: skip
        verdict = cloudwatch.CfnAlarm.MetricDataQueryProperty(
            id="verdict", expression=alarm.expression, return_data=True
        )
        identity = "".join(word.capitalize() for word in alarm.name.split("-"))
        cloudwatch.CfnAlarm(
            self, f"{identity}Alarm", alarm_name=names.alarm(alarm.name),
            alarm_description=f"{alarm.meaning}; runbook: docs/operations.md#{alarm.name}",
            metrics=[*queries, verdict], comparison_operator=alarm.comparison, threshold=alarm.threshold,
            evaluation_periods=alarm.periods, datapoints_to_alarm=alarm.datapoints,
            treat_missing_data=alarm.missing, alarm_actions=[topic], ok_actions=[topic],
        )  # fmt: skip

    def _series(self, series: Series) -> cloudwatch.CfnAlarm.MetricProperty:
        return cloudwatch.CfnAlarm.MetricProperty(
            namespace=series.namespace, metric_name=series.metric,
            dimensions=[
                cloudwatch.CfnAlarm.DimensionProperty(name=name, value=value)
                for name, value in self._dimensions[series.source].items()
            ],
        )  # fmt: skip

    def _budget(self, names: ResourceNames, usd: float, topic: str) -> None:
        """Add a monthly budget of *usd* US dollars, whose notifications go to the topic.

        The budget covers the costs of the whole account: AWS separates costs by a tag only after the tag was
        activated by hand.
        """
        budgets.CfnBudget(
            self, "Budget",
            budget=budgets.CfnBudget.BudgetDataProperty(
                budget_name=names.budget, budget_type="COST", time_unit="MONTHLY",
                budget_limit=budgets.CfnBudget.SpendProperty(amount=usd, unit="USD"),
            ),
            notifications_with_subscribers=[
                budgets.CfnBudget.NotificationWithSubscribersProperty(
                    notification=budgets.CfnBudget.NotificationProperty(
                        notification_type=kind, comparison_operator="GREATER_THAN",
                        threshold=percent, threshold_type="PERCENTAGE",
                    ),
                    subscribers=[
                        budgets.CfnBudget.SubscriberProperty(subscription_type="SNS", address=topic)
                    ],
                )
                for kind, percent in (
                    ("ACTUAL", _BUDGET_ACTUAL_PERCENT), ("FORECASTED", _BUDGET_FORECAST_PERCENT),
                )
            ],
        )  # fmt: skip


def _after(arn: str, word: str) -> str:
    """Return the text that follows *word* in *arn*, as an expression for CloudFormation."""
    return cdk.Fn.select(1, cdk.Fn.split(word, arn))
