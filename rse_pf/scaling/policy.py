"""Decide when the platform grows, shrinks or replaces a server: the paper's scale modifier as a pure rule.

`decide` takes measurements and the time, keeps no state between calls, and returns what the caller has to do.
A period without a sample is no reason to act.  The rules are those of `rse_pf.scaling.rules`; CloudWatch
applies the same ones on AWS, and a test compares the two, in both profiles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from rse_pf.config import ScalingSettings
from rse_pf.scaling.profile import cadence_of
from rse_pf.scaling.rules import Sample, ScalingRule, rules_of

__all__ = ["Action", "FleetState", "Kind", "decide", "find_rule_starts"]

Kind = Literal["grow", "shrink", "replace", "stay"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FleetState:
    """The current servers: their number, those still warming up, and the names of the unhealthy ones.

    ``acted_s`` is when the number of servers was last changed: each period leads to one change at most.
    """

    servers: int
    warming: int = 0
    unhealthy: tuple[str, ...] = ()
    acted_s: float = -math.inf


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
    compress: float = 1.0,
    since_s: Mapping[str, float] | None = None,
) -> tuple[Action, ...]:
    """Return what to do now: replacements first, then exactly one of grow, shrink or stay.

    A platform that stays busy grows again every minute, or every period where that is longer; servers that
    still warm up count as already added, as in step scaling of Amazon EC2 Auto Scaling, and block every
    shrink.

    Args:
        samples: Whole periods, in order; later ones than *now_s* are ignored.
        fleet: The servers now.
        settings: Profile, thresholds and limits.
        now_s: Seconds, on the clock of the samples.
        compress: Factor by which periods are shorter; for experiments.
        since_s: What `find_rule_starts` returned; None finds it in *samples*, which must then
            reach back so far.

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
    cadence = cadence_of(settings)
    period_s = cadence.period_s / compress
    ended = _periods(now_s, period_s)
    if fleet.servers < settings.min_servers:
        missing = settings.min_servers - fleet.servers
        return (*replacements, Action(kind="grow", servers=missing, reason="fewer than scaling.min_servers"))
    if math.isfinite(fleet.acted_s) and ended <= _periods(fleet.acted_s, period_s):
        return (*replacements, Action(kind="stay", reason="this period has led to an action already"))
    by_period = {round(sample.start_s / period_s): sample for sample in samples}
    if since_s is None:
        since_s = _find_starts(by_period, ended, settings, period_s, {})
    acting = [
        rule
        for rule in rules_of(settings)
        if rule.name in since_s
        and (ended - _periods(since_s[rule.name], period_s)) % cadence.repeat == 0
        and ended - 1 in by_period
    ]
    return (*replacements, _scale(acting, by_period.get(ended - 1), fleet, settings))


def find_rule_starts(
    samples: Sequence[Sample],
    settings: ScalingSettings,
    *,
    now_s: float,
    compress: float = 1.0,
    before: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Return since when each rule that holds now has held without a break, by its name, in seconds.

    Args:
        samples: Whole periods, as many as the longest rule needs, and one more.
        settings: As for `decide`.
        now_s: As for `decide`.
        compress: As for `decide`.
        before: What this returned a period ago; None at the first call.
    """
    period_s = cadence_of(settings).period_s / compress
    by_period = {round(sample.start_s / period_s): sample for sample in samples}
    return _find_starts(by_period, _periods(now_s, period_s), settings, period_s, before or {})


def _find_starts(
    by_period: Mapping[int, Sample],
    ended: int,
    settings: ScalingSettings,
    period_s: float,
    before: Mapping[str, float],
) -> dict[str, float]:
    """Return since when each rule holds; a run as long as the history began when *before* says."""
    starts_s, oldest = {}, min(by_period, default=ended)
    for rule in rules_of(settings):
        first = ended
        while first - 1 in by_period and rule.holds(by_period[first - 1]):
            first -= 1
        if ended - first >= rule.samples:
            began_s = (first + rule.samples) * period_s
            starts_s[rule.name] = min(began_s, before.get(rule.name, began_s)) if first == oldest else began_s
    return starts_s


def _scale(
    acting: Sequence[ScalingRule], newest: Sample | None, fleet: FleetState, settings: ScalingSettings
) -> Action:
    if newest is None or not acting:
        return Action(kind="stay", reason="neither busy nor idle")
    growing = [rule for rule in acting if rule.grows]
    if growing:
        rule = max(growing, key=lambda growing_rule: growing_rule.change(newest))
        reason = rule.explain(newest)
        target = min(settings.max_servers, fleet.servers - fleet.warming + rule.change(newest))
        more = target - fleet.servers
        if more > 0:
            return Action(kind="grow", servers=more, reason=reason)
        bound = target == settings.max_servers
        return Action(
            kind="stay", reason=f"{reason}, but {'at scaling.max_servers' if bound else 'still warming up'}"
        )
    reason = acting[0].explain(newest)
    if fleet.warming:
        return Action(kind="stay", reason=f"{reason}, but still warming up")
    if fleet.servers > settings.min_servers:
        return Action(kind="shrink", servers=1, reason=reason)
    return Action(kind="stay", reason=f"{reason}, at scaling.min_servers")


def _periods(now_s: float, period_s: float) -> int:
    """Return how many periods have ended by *now_s*."""
    # The small term guards against a start that is a rounding error below its multiple.
    return math.floor(now_s / period_s + 1e-6)
