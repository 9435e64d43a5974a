"""The scaling policy as CloudWatch data: metrics, alarms and step adjustments.

This is the only translation of `rse_pf.scaling.policy.decide`.  The stacks write the alarms into the
template; tests read them back from it and compare both on the same load.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rse_pf.config import ScalingSettings
from rse_pf.config.elasticity import IDLE_CPU_PERCENT, UNDERUSED_CPU_PERCENT
from rse_pf.scaling.policy import BIG_STEP, STEP
from rse_pf.scaling.profile import cadence_of

__all__ = ["CPU", "NAMESPACE", "Alarm", "Metric", "ScalingStep", "alarms_of"]

NAMESPACE = "RsePf"
"""CloudWatch namespace of what the backend servers publish."""

CPU = "CpuPercent"
"""CPU of a server past its warm-up; published in the fast profile only."""

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
    """An alarm and the step policy that runs while its state is ALARM: at once, and then every minute.

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
_FAST_CPU = Metric(name="cpu", namespace=NAMESPACE, metric=CPU, statistic="Average")
_REQUESTS = Metric(name="requests", namespace=NAMESPACE, metric="Requests", statistic="Sum")
_ROBOTS = Metric(name="robots", namespace=NAMESPACE, metric="Robots", statistic="Average")
_QUEUE = Metric(name="queue", namespace=NAMESPACE, metric="QueueMs", statistic="Maximum")


def alarms_of(settings: ScalingSettings) -> tuple[Alarm, ...]:
    """Return the alarms that correspond to `decide`: busy, idle, then those that are enabled.

    Missing data never breaches: a fleet without data neither grows nor shrinks.
    """
    cpu = _FAST_CPU if cadence_of(settings).is_fast else _CPU
    further = settings.very_busy_cpu_percent - settings.busy_cpu_percent
    steps = [ScalingStep(lower=0.0, upper=further, change=STEP)] if further else []
    busy = _grow(
        settings,
        "busy",
        cpu,
        settings.busy_cpu_percent,
        (*steps, ScalingStep(lower=further, upper=None, change=BIG_STEP)),
        "the average CPU of the servers is too high",
    )
    cadence = cadence_of(settings)
    alarms = [busy, _idle(settings, cpu)]
    if cadence.underused:
        alarms.append(_underused(settings, cpu))
    single_step = (ScalingStep(lower=0.0, upper=None, change=STEP),)
    if settings.max_robots_per_server:
        alarms.append(
            _grow(
                settings,
                "crowded",
                _ROBOTS,
                float(settings.max_robots_per_server),
                single_step,
                "too many robots on each server",
            )
        )
    if settings.max_queue_ms:
        alarms.append(
            _grow(settings, "queueing", _QUEUE, settings.max_queue_ms, single_step, "commands wait too long")
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
    cadence = cadence_of(settings)
    return Alarm(
        name=name,
        metrics=(metric,),
        expression=metric.name,
        comparison="GreaterThanOrEqualToThreshold",
        threshold=threshold,
        period_s=cadence.period_s,
        periods=cadence.busy,
        missing="notBreaching",
        steps=steps,
        meaning=meaning,
    )


def _idle(settings: ScalingSettings, cpu: Metric) -> Alarm:
    conditions = {_REQUESTS: "== 0", cpu: f"< {IDLE_CPU_PERCENT:g}", **_spare(settings, 1.0)}
    cadence = cadence_of(settings)
    return _shrink(
        "idle", conditions, cadence.period_s, cadence.idle, "there were no requests, and the servers are idle"
    )


def _underused(settings: ScalingSettings, cpu: Metric) -> Alarm:
    conditions = {cpu: f"< {UNDERUSED_CPU_PERCENT:g}", **_spare(settings, 0.5)}
    cadence = cadence_of(settings)
    return _shrink(
        "underused", conditions, cadence.period_s, cadence.underused, "a server less can do the work"
    )


def _spare(settings: ScalingSettings, share: float) -> dict[Metric, str]:
    """Return what keeps servers that the limits would add again; empty if no limit is on."""
    limits = ((_ROBOTS, settings.max_robots_per_server), (_QUEUE, settings.max_queue_ms))
    return {metric: f"< {share * limit:g}" for metric, limit in limits if limit}


def _shrink(name: str, conditions: Mapping[Metric, str], period_s: int, periods: int, meaning: str) -> Alarm:
    conditions_text = " AND ".join(f"{metric.name} {limit}" for metric, limit in conditions.items())
    return Alarm(
        name=name,
        metrics=tuple(conditions),
        expression=f"IF({conditions_text}, 1, 0)",
        comparison="GreaterThanOrEqualToThreshold",
        threshold=1.0,
        period_s=period_s,
        periods=periods,
        missing="notBreaching",
        steps=(ScalingStep(lower=0.0, upper=None, change=-1),),
        meaning=meaning,
    )
