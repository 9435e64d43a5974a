"""The rules of scaling as CloudWatch data: metrics, alarms and step adjustments.

The stacks write the alarms into the CloudFormation template.  Tests read them from the template, and compare
their decisions with those of `rse_pf.scaling.policy.decide` on the same load.
"""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.config import ScalingSettings
from rse_pf.scaling.profile import cadence_of
from rse_pf.scaling.rules import Field, ScalingRule, ScalingStep, rules_of

__all__ = ["CPU", "NAMESPACE", "Alarm", "Metric", "alarms_of"]

NAMESPACE = "RsePf"
"""CloudWatch namespace of the metrics that the agents of the backend servers publish."""

CPU = "CpuPercent"
"""Metric of a server's CPU utilisation in percent, after its warm-up; published in the fast profile only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """A CloudWatch metric with its statistic; ``name`` is its name in the expression of an `Alarm`."""

    name: str
    namespace: str
    metric: str
    statistic: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """A CloudWatch alarm, and the step policy that runs when its state becomes ALARM and then every minute.

    The state becomes ALARM when *expression* breaches *threshold* in *periods* consecutive periods of
    *period_s* seconds.  ``comparison`` and ``missing`` (treatment of missing data) are CloudWatch's terms.
    """

    name: str
    metrics: tuple[Metric, ...]
    expression: str
    threshold: float
    period_s: int
    periods: int
    steps: tuple[ScalingStep, ...]
    meaning: str
    comparison: str = "GreaterThanOrEqualToThreshold"
    missing: str = "notBreaching"


_METRICS: dict[Field, Metric] = {
    "cpu_percent": Metric(
        name="cpu", namespace="AWS/EC2", metric="CPUUtilization", statistic="Average"
    ),
    "requests": Metric(name="requests", namespace=NAMESPACE, metric="Requests", statistic="Sum"),
    "robots_per_server": Metric(name="robots", namespace=NAMESPACE, metric="Robots", statistic="Average"),
}  # fmt: skip
"""The CloudWatch metric that gives each field of a `rse_pf.scaling.rules.Sample`, in the paper's profile."""
_FAST_METRICS: dict[Field, Metric] = {
    **_METRICS, "cpu_percent": Metric(name="cpu", namespace=NAMESPACE, metric=CPU, statistic="Average"),
}  # fmt: skip
"""As `_METRICS`, in the fast profile: the servers publish their CPU, because EC2 does so only each minute."""


def alarms_of(settings: ScalingSettings) -> tuple[Alarm, ...]:
    """Return an alarm for each rule of `rules_of`, in the same order.

    Missing data never breaches: a fleet without data neither grows nor shrinks.
    """
    return tuple(_alarm_of(rule, settings) for rule in rules_of(settings))


def _alarm_of(rule: ScalingRule, settings: ScalingSettings) -> Alarm:
    """Return the alarm of *rule*.

    A rule that adds servers compares its metric with its limit.  A rule that removes one has an expression
    that is 1 while all its conditions hold, else 0, and the threshold 1.
    """
    cadence = cadence_of(settings)
    of_field = _FAST_METRICS if cadence.is_fast else _METRICS
    metrics = tuple(of_field[condition.field] for condition in rule.conditions)
    expression, threshold, steps = metrics[0].name, rule.conditions[0].limit, rule.steps
    if not rule.grows:
        comparisons = (
            f"{metric.name} {condition.comparison} {condition.limit:g}"
            for metric, condition in zip(metrics, rule.conditions, strict=True)
        )
        expression, threshold = f"IF({' AND '.join(comparisons)}, 1, 0)", 1.0
        steps = (ScalingStep(lower=0.0, upper=None, change=rule.steps[0].change),)
    return Alarm(
        name=rule.name,
        metrics=metrics,
        expression=expression,
        threshold=threshold,
        period_s=cadence.period_s,
        periods=rule.samples,
        steps=steps,
        meaning=rule.meaning,
    )
