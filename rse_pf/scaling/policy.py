"""Decide when the platform grows, shrinks or replaces a server: the paper's scale modifier as a pure rule.

`decide` takes measurements and the time, keeps no state between calls, and returns what the caller has to do.
A rule never acts on a period without a sample.  The rules are those of `rse_pf.scaling.rules`; on AWS
CloudWatch applies the same rules, and a test compares `decide` with CloudWatch's alarms in both profiles.
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
    """The servers of the fleet now.

    Attributes:
        servers: Number of servers, those that warm up included.
        warming: Number of servers that still warm up.
        unhealthy: Names of the servers that failed their health checks.
        acted_s: Time at which the number of servers last changed; each period leads to one change at most.
    """

    servers: int
    warming: int = 0
    unhealthy: tuple[str, ...] = ()
    acted_s: float = -math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """One action on the fleet.

    Attributes:
        kind: ``grow``, ``shrink``, ``replace`` or ``stay``.
        servers: Number of servers to add, remove or replace; 0 for ``stay``.
        names: The servers to replace; empty for other kinds.
        reason: Text for the log.
    """

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
    """Return what to do now: one replacement if servers are unhealthy, then one of grow, shrink or stay.

    A fleet below ``scaling.min_servers`` grows at once to this number; otherwise each period leads to one
    change at most.  A platform that stays busy grows again every minute, or every period if a period is
    longer.  Servers that still warm up count as already added, as in step scaling of Amazon EC2 Auto Scaling;
    while there are any, the fleet does not shrink.

    Args:
        samples: Measurements of whole periods, in order; those that begin after *now_s* are ignored.
        fleet: The servers now.
        settings: Profile, thresholds and limits.
        now_s: Seconds, on the clock of the samples.
        compress: Factor by which periods are shorter than the settings say; for experiments.
        since_s: The result of `find_rule_starts`; None computes it from *samples*, which must then reach back
            to the first sample of each rule that holds.

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
    ended = _count_periods(now_s, period_s)
    if fleet.servers < settings.min_servers:
        missing = settings.min_servers - fleet.servers
        return (*replacements, Action(kind="grow", servers=missing, reason="fewer than scaling.min_servers"))
    if math.isfinite(fleet.acted_s) and ended <= _count_periods(fleet.acted_s, period_s):
        return (*replacements, Action(kind="stay", reason="this period has led to an action already"))
    by_period = {round(sample.start_s / period_s): sample for sample in samples}
    if since_s is None:
        since_s = _find_starts(by_period, ended, settings, period_s, {})
    acting = [
        rule
        for rule in rules_of(settings)
        if rule.name in since_s
        and (ended - _count_periods(since_s[rule.name], period_s)) % cadence.repeat == 0
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
    """Return, by name, the time in seconds since which each rule that is fulfilled now has been fulfilled.

    A rule is fulfilled when its conditions held in the last samples, as many in a row as it needs.

    Args:
        samples: Measurements of whole periods: as many as the longest rule needs, and one more.
        settings: As for `decide`.
        now_s: As for `decide`.
        compress: As for `decide`.
        before: The result of the call one period ago, for rules that have held for longer than *samples*
            reach back; None at the first call.
    """
    period_s = cadence_of(settings).period_s / compress
    by_period = {round(sample.start_s / period_s): sample for sample in samples}
    return _find_starts(by_period, _count_periods(now_s, period_s), settings, period_s, before or {})


def _find_starts(
    by_period: Mapping[int, Sample],
    ended: int,
    settings: ScalingSettings,
    period_s: float,
    before: Mapping[str, float],
) -> dict[str, float]:
    """Compute `find_rule_starts` from samples by number of their period, of which *ended* have ended.

    If the conditions of a rule hold in all samples, the rule may have held longer: then the earlier time in
    *before* counts.
    """
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


def _count_periods(now_s: float, period_s: float) -> int:
    """Return the number of periods of *period_s* that have ended by *now_s*."""
    # The small term corrects times that a rounding error puts just below a multiple of the period.
    return math.floor(now_s / period_s + 1e-6)
