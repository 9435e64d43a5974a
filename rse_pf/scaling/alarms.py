"""The rules of scaling as CloudWatch data: metrics, alarms and step adjustments.

The stacks write the alarms into the template; tests read them back from it and compare them with
`rse_pf.scaling.policy.decide` on the same load.
"""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.config import ScalingSettings
from rse_pf.scaling.profile import cadence_of
from rse_pf.scaling.rules import Field, ScalingRule, ScalingStep, rules_of

__all__ = ["CPU", "NAMESPACE", "Alarm", "Metric", "alarms_of"]

NAMESPACE = "RsePf"
"""CloudWatch namespace of what the backend servers publish."""

CPU = "CpuPercent"
"""CPU of a server past its warm-up; published in the fast profile only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """One time series; ``name`` is its name in an expression."""

    name: str
    namespace: str
    metric: str
    statistic: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """An alarm and the step policy that runs while its state is ALARM: at once, and then every minute.

    ``comparison`` and ``missing`` are terms of CloudWatch; *periods* of *periods* must breach.
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
"""The metric of each field of a `rse_pf.scaling.rules.Sample`."""
_FAST_METRICS: dict[Field, Metric] = {
    **_METRICS, "cpu_percent": Metric(name="cpu", namespace=NAMESPACE, metric=CPU, statistic="Average"),
}  # fmt: skip
"""The same in the fast profile: EC2 publishes its CPU only each minute."""


def alarms_of(settings: ScalingSettings) -> tuple[Alarm, ...]:
    """Return one alarm for each of `rules_of`, in the same order.

    Missing data never breaches: a fleet without data neither grows nor shrinks.
    """
    return tuple(_alarm_of(rule, settings) for rule in rules_of(settings))


def _alarm_of(rule: ScalingRule, settings: ScalingSettings) -> Alarm:
    """Return *rule* as an alarm: on its metric if it adds servers, else on an expression that is 0 or 1."""
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
