"""Decide when the platform grows, shrinks or replaces a server: the paper's scale modifier as a pure rule.

`decide` takes measurements and the time, keeps no state between calls, and returns what the caller has to do.
A period without a sample is no reason to act.  `rse_pf.scaling.alarms` describes the same policy to
CloudWatch; a test compares the two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rse_pf.config import ScalingSettings

__all__ = ["Action", "FleetState", "Kind", "Sample", "decide"]

Kind = Literal["grow", "shrink", "replace", "stay"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """Measurements of one whole period, over all servers that are past their warm-up.

    ``start_s`` is the begin of the period, so a sample covers ``[start_s, start_s + period)``.
    """

    start_s: float
    cpu_percent: float
    requests: float
    robots_per_server: float = 0.0
    queue_ms: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetState:
    """The current servers: their number, those still warming up, and the names of the unhealthy ones."""

    servers: int
    warming: int = 0
    unhealthy: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """One action.  ``names`` are the servers to replace; ``reason`` is for the log."""

    kind: Kind
    servers: int = 0
    names: tuple[str, ...] = ()
    reason: str = ""


def decide(
    samples: Sequence[Sample],
    fleet: FleetState,
    settings: ScalingSettings,
    *,
    now_s: float,
    acted_s: float = -math.inf,
    compress: float = 1.0,
) -> tuple[Action, ...]:
    """Return what to do now: replacements first, then exactly one of grow, shrink or stay.

    A busy platform grows again in every period that stays busy; servers that still warm up count as
    already added, as in step scaling of Amazon EC2 Auto Scaling, and block every shrink.

    Args:
        samples: Whole periods, in order; later ones than *now_s* are ignored.
        fleet: The servers now.
        settings: Thresholds and limits.
        now_s: Seconds, on the clock of the samples.
        acted_s: When the number of servers was last changed; each period leads to one change at most.
        compress: Factor by which periods are shorter; for experiments.

    Source:
        RSE-PF paper, Sect. 6.2: busy above 70 % CPU, one server less after five idle minutes.
    """
    replacements: tuple[Action, ...] = ()
    if fleet.unhealthy:
        replacements = (
            Action(
                kind="replace",
                servers=len(fleet.unhealthy),
                names=fleet.unhealthy,
                reason=f"{len(fleet.unhealthy)} failed their health checks",
            ),
        )
    period_s = settings.period_s / compress
    # The small term guards against a start that is a rounding error below its multiple.
    ended = math.floor(now_s / period_s + 1e-6)
    if fleet.servers < settings.min_servers:
        missing = settings.min_servers - fleet.servers
        return (*replacements, Action(kind="grow", servers=missing, reason="fewer than scaling.min_servers"))
    if math.isfinite(acted_s) and ended <= math.floor(acted_s / period_s + 1e-6):
        return (*replacements, Action(kind="stay", reason="this period has led to an action already"))
    by_period = {round(sample.start_s / period_s): sample for sample in samples}
    return (*replacements, _scale(by_period, ended, fleet, settings))


def _scale(by_period: dict[int, Sample], ended: int, fleet: FleetState, settings: ScalingSettings) -> Action:
    growth, reason = _growth(_last(by_period, ended, settings.busy_periods), settings)
    if growth:
        target = min(settings.max_servers, fleet.servers - fleet.warming + growth)
        more = target - fleet.servers
        if more > 0:
            return Action(kind="grow", servers=more, reason=reason)
        bound = target == settings.max_servers
        return Action(
            kind="stay", reason=f"{reason}, but {'at scaling.max_servers' if bound else 'still warming up'}"
        )
    if _idle(_last(by_period, ended, settings.idle_s // settings.period_s), settings):
        if fleet.warming:
            return Action(kind="stay", reason="idle, but still warming up")
        if fleet.servers > settings.min_servers:
            return Action(kind="shrink", servers=1, reason=f"idle for {settings.idle_s} s")
        return Action(kind="stay", reason="idle, at scaling.min_servers")
    return Action(kind="stay", reason="neither busy nor idle")


def _last(by_period: dict[int, Sample], ended: int, count: int) -> list[Sample]:
    """Return the samples of the last *count* whole periods, or nothing if one is missing."""
    found = [by_period[each] for each in range(ended - count, ended) if each in by_period]
    return found if len(found) == count else []


def _growth(last: list[Sample], settings: ScalingSettings) -> tuple[int, str]:
    """Return by how many servers to grow, and why; 0 if the servers are not busy."""
    if not last:
        return 0, ""
    if all(sample.cpu_percent >= settings.busy_cpu_percent for sample in last):
        newest = last[-1].cpu_percent
        very = newest >= settings.very_busy_cpu_percent
        return (settings.big_step if very else settings.step), f"CPU at {newest:.0f} %"
    if settings.max_robots_per_server and all(
        sample.robots_per_server >= settings.max_robots_per_server for sample in last
    ):
        return settings.step, f"{last[-1].robots_per_server:.0f} robots on each server"
    if settings.max_queue_ms and all(sample.queue_ms >= settings.max_queue_ms for sample in last):
        return settings.step, f"commands wait {last[-1].queue_ms:.0f} ms"
    return 0, ""


def _idle(last: list[Sample], settings: ScalingSettings) -> bool:
    return bool(last) and all(
        sample.requests == 0 and sample.cpu_percent < settings.idle_cpu_percent for sample in last
    )
