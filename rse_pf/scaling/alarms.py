"""The scaling policy as CloudWatch data: metrics, alarms and step adjustments.

This is the only translation of `rse_pf.scaling.policy.decide`.  The stacks write the alarms into the
template; tests read them back from it and compare both on the same load.
"""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.config import ScalingSettings

__all__ = ["NAMESPACE", "Alarm", "Metric", "ScalingStep", "alarms_of"]

NAMESPACE = "RsePf"
"""CloudWatch namespace of what the backend servers publish."""

_EC2 = "AWS/EC2"


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """One time series; ``name`` is its name in an expression."""

    name: str
    namespace: str
    metric: str
    statistic: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingStep:
    """Change the number of servers while the value lies in ``[lower, upper)`` above the threshold."""

    lower: float | None
    upper: float | None
    change: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """An alarm and the step policy that runs in every period in which its state is ALARM.

    ``comparison`` and ``missing`` are terms of CloudWatch; *periods* of *periods* must breach.
    """

    name: str
    metrics: tuple[Metric, ...]
    expression: str
    comparison: str
    threshold: float
    period_s: int
    periods: int
    missing: str
    steps: tuple[ScalingStep, ...]
    meaning: str


_CPU = Metric(name="cpu", namespace=_EC2, metric="CPUUtilization", statistic="Average")
_REQUESTS = Metric(name="requests", namespace=NAMESPACE, metric="Requests", statistic="Sum")
_ROBOTS = Metric(name="robots", namespace=NAMESPACE, metric="Robots", statistic="Average")
_QUEUE = Metric(name="queue", namespace=NAMESPACE, metric="QueueMs", statistic="Maximum")


def alarms_of(settings: ScalingSettings) -> tuple[Alarm, ...]:
    """Return the alarms that correspond to `decide`: busy, idle, then those that are enabled.

    Missing data never breaches: a fleet without data neither grows nor shrinks.
    """
    further = settings.very_busy_cpu_percent - settings.busy_cpu_percent
    steps = [ScalingStep(lower=0.0, upper=further, change=settings.step)] if further else []
    busy = _grow(
        settings,
        "busy",
        _CPU,
        settings.busy_cpu_percent,
        (*steps, ScalingStep(lower=further, upper=None, change=settings.big_step)),
        "the average CPU of the servers is too high",
    )
    idle = Alarm(
        name="idle",
        metrics=(_CPU, _REQUESTS),
        expression=f"IF(requests == 0 AND cpu < {settings.idle_cpu_percent:g}, 1, 0)",
        comparison="GreaterThanOrEqualToThreshold",
        threshold=1.0,
        period_s=settings.period_s,
        periods=settings.idle_s // settings.period_s,
        missing="notBreaching",
        steps=(ScalingStep(lower=0.0, upper=None, change=-1),),
        meaning="there were no requests, and the servers are idle",
    )
    alarms = [busy, idle]
    one = (ScalingStep(lower=0.0, upper=None, change=settings.step),)
    if settings.max_robots_per_server:
        alarms.append(
            _grow(
                settings,
                "crowded",
                _ROBOTS,
                float(settings.max_robots_per_server),
                one,
                "too many robots on each server",
            )
        )
    if settings.max_queue_ms:
        alarms.append(
            _grow(settings, "queueing", _QUEUE, settings.max_queue_ms, one, "commands wait too long")
        )
    return tuple(alarms)


def _grow(
    settings: ScalingSettings,
    name: str,
    metric: Metric,
    threshold: float,
    steps: tuple[ScalingStep, ...],
    meaning: str,
) -> Alarm:
    return Alarm(
        name=name,
        metrics=(metric,),
        expression=metric.name,
        comparison="GreaterThanOrEqualToThreshold",
        threshold=threshold,
        period_s=settings.period_s,
        periods=settings.busy_periods,
        missing="notBreaching",
        steps=steps,
        meaning=meaning,
    )
