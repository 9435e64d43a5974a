"""Monitor and scale modifier of Fig. 2: CloudWatch alarms of `rse_pf.scaling.alarms` with step policies."""

from __future__ import annotations

from aws_cdk import aws_autoscaling as autoscaling
from aws_cdk import aws_cloudwatch as cloudwatch
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.scaling.alarms import Alarm, Metric, alarms_of

__all__ = ["ScaleModifier"]


class ScaleModifier(Construct):
    """A CloudWatch alarm and a step scaling policy of the group for each rule of `rse_pf.scaling.rules`."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        group_name: str,
        topic_arn: str,
        settings: PlatformSettings,
    ) -> None:
        super().__init__(scope, construct_id)
        self._names = ResourceNames(settings.cloud.name)
        for alarm in alarms_of(settings.scaling):
            self._alarm(alarm, group_name, topic_arn, settings.scaling.warm_up_s)

    def _alarm(self, alarm: Alarm, group_name: str, topic_arn: str, warm_up_s: int) -> None:
        grows = alarm.steps[-1].change > 0
        policy = autoscaling.CfnScalingPolicy(
            self, f"{alarm.name.capitalize()}Policy", auto_scaling_group_name=group_name,
            policy_type="StepScaling", adjustment_type="ChangeInCapacity", metric_aggregation_type="Average",
            estimated_instance_warmup=warm_up_s if grows else None,
            step_adjustments=[
                autoscaling.CfnScalingPolicy.StepAdjustmentProperty(
                    metric_interval_lower_bound=step.lower, metric_interval_upper_bound=step.upper,
                    scaling_adjustment=step.change,
                )
                for step in alarm.steps
            ],
        )  # fmt: skip
        queries = [
            cloudwatch.CfnAlarm.MetricDataQueryProperty(
                id=metric.name, return_data=False,
                metric_stat=cloudwatch.CfnAlarm.MetricStatProperty(
                    period=alarm.period_s, stat=metric.statistic, metric=_series(metric, group_name)
                ),
            )
            for metric in alarm.metrics
        ]  # fmt: skip
        verdict = cloudwatch.CfnAlarm.MetricDataQueryProperty(
            id="verdict", expression=alarm.expression, return_data=True
        )
        cloudwatch.CfnAlarm(
            self, f"{alarm.name.capitalize()}Alarm", alarm_name=self._names.alarm(alarm.name),
            alarm_description=f"{alarm.meaning}; runbook: docs/operations.md#{alarm.name}",
            metrics=[*queries, verdict], comparison_operator=alarm.comparison, threshold=alarm.threshold,
            evaluation_periods=alarm.periods, datapoints_to_alarm=alarm.periods,
            treat_missing_data=alarm.missing, alarm_actions=[policy.ref, topic_arn],
        )  # fmt: skip


def _series(metric: Metric, group_name: str) -> cloudwatch.CfnAlarm.MetricProperty:
    return cloudwatch.CfnAlarm.MetricProperty(
        namespace=metric.namespace, metric_name=metric.metric,
        dimensions=[
            cloudwatch.CfnAlarm.DimensionProperty(name="AutoScalingGroupName", value=group_name)
        ],
    )  # fmt: skip
