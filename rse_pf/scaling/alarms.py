"""Say the scaling policy in CloudWatch's words: metrics, alarms and step adjustments, as data.

The stacks write these alarms into the template; tests parse them back and run them beside
`rse_pf.scaling.policy.decide`.  Promises to be the only place that translates the one into the other.
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
    """One time series; ``name`` is how an expression calls it."""

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
    """An alarm and the step policy it runs in every period in which it stands in ALARM.

    ``comparison`` and ``missing`` are CloudWatch's words; *periods* of *periods* must breach.
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
    """Return the alarms that do what `decide` does, in the order busy, idle, then what is switched on.

    Missing data never breaches: a fleet that nobody hears of is neither grown nor shrunk.
    """
    further = settings.very_busy_cpu_percent - settings.busy_cpu_percent
    steps = [ScalingStep(lower=0.0, upper=further, change=settings.step)] if further else []
    busy = _grow(
        settings,
        "busy",
        _CPU,
        settings.busy_cpu_percent,
        (*steps, ScalingStep(lower=further, upper=None, change=settings.big_step)),
        "the servers compute more than they should",
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
        meaning="no robot asked for anything, and the servers rest",
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
