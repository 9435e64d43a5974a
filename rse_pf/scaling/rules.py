"""The rules of scaling as one table: conditions, for how many samples in a row, and by how many servers.

`rse_pf.scaling.policy` applies the table on one machine, and `rse_pf.scaling.alarms` translates it into
CloudWatch alarms.  A rule that adds servers has one condition; a rule that removes one may have several.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Literal

from rse_pf.config import ScalingSettings
from rse_pf.config.elasticity import IDLE_CPU_PERCENT, UNDERUSED_CPU_PERCENT
from rse_pf.scaling.profile import cadence_of

__all__ = ["BIG_STEP", "STEP", "Condition", "Field", "Sample", "ScalingRule", "ScalingStep", "rules_of"]

# Number of servers that a rule adds or removes at a time, as in the paper.
STEP = 1
# Number of servers added above `scaling.very_busy_cpu_percent`: one server more would soon be busy again.
BIG_STEP = 2
# Fraction of `scaling.max_robots_per_server` below which a server may be removed although robots send
# commands: when one of two servers is removed, the other one gets twice as many robots.
_SPARE_FRACTION = 0.5

Field = Literal["cpu_percent", "requests", "robots_per_server"]
"""Name of a field of `Sample` that a condition may compare."""
_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge, "<": operator.lt, "==": operator.eq,
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """Measurements of one whole period, over all servers that are past their warm-up.

    Attributes:
        start_s: Start of the period in seconds; the sample covers ``[start_s, start_s + period)``.
        cpu_percent: Mean CPU utilisation of the servers.
        requests: Number of requests to all servers in the period.
        robots_per_server: Mean number of robots of a server.
    """

    start_s: float
    cpu_percent: float
    requests: float
    robots_per_server: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Condition:
    """A comparison of one field of a `Sample` with a limit; ``comparison`` is ``>=``, ``<`` or ``==``."""

    field: Field
    comparison: str
    limit: float

    def holds(self, sample: Sample) -> bool:
        """Return whether *sample* meets the condition."""
        return _OPERATORS[self.comparison](getattr(sample, self.field), self.limit)


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingStep:
    """The change of the number of servers while a value lies *lower* to *upper* above the rule's limit.

    *upper* is excluded; None means no bound; a negative change removes servers.
    """

    lower: float | None
    upper: float | None
    change: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingRule:
    """Conditions that must hold in some samples in a row, and the change of the fleet that follows.

    Attributes:
        name: Name of the rule, of its alarm, and of the alarm's chapter in docs/operations.md.
        meaning: Text for the description of the alarm.
        conditions: All of them must hold.
        samples: Number of samples in a row in which they must hold.
        steps: Changes of the number of servers, by how far the first condition's field is above its limit.
        reason: Text for the log, a format string with fields of the newest `Sample`.
    """

    name: str
    meaning: str
    conditions: tuple[Condition, ...]
    samples: int
    steps: tuple[ScalingStep, ...]
    reason: str

    @property
    def grows(self) -> bool:
        """Return whether the rule adds servers."""
        return self.steps[-1].change > 0

    def holds(self, sample: Sample) -> bool:
        """Return whether *sample* meets all conditions."""
        return all(condition.holds(sample) for condition in self.conditions)

    def change(self, sample: Sample) -> int:
        """Return by how many servers the rule changes the fleet for a *sample* that meets its conditions."""
        above = getattr(sample, self.conditions[0].field) - self.conditions[0].limit
        return next(step.change for step in self.steps if step.upper is None or above < step.upper)

    def explain(self, sample: Sample) -> str:
        """Return the text for the log, with the numbers of *sample*."""
        return self.reason.format(**asdict(sample))


def rules_of(settings: ScalingSettings) -> tuple[ScalingRule, ...]:
    """Return the rules that *settings* enable; the rules that add servers come first.

    Source:
        RSE-PF paper, Sect. 6.2: busy above 70 % CPU, one server less after five idle minutes; Sect. 3.1: a
        limit on the robots of a server.
    """
    cadence, busy_percent = cadence_of(settings), settings.busy_cpu_percent
    further_percent = settings.very_busy_cpu_percent - busy_percent
    steps = (ScalingStep(lower=0.0, upper=further_percent, change=STEP),) if further_percent else ()
    one_more = ScalingStep(lower=0.0, upper=None, change=STEP)
    one_less = ScalingStep(lower=None, upper=None, change=-STEP)
    robots = float(settings.max_robots_per_server)
    rules = [
        ScalingRule(
            name="busy",
            meaning="the average CPU of the servers is too high",
            conditions=(Condition(field="cpu_percent", comparison=">=", limit=busy_percent),),
            samples=cadence.busy,
            steps=(*steps, ScalingStep(lower=further_percent, upper=None, change=BIG_STEP)),
            reason="CPU at {cpu_percent:.0f} %",
        )
    ]
    if robots:
        rules.append(
            ScalingRule(
                name="crowded",
                meaning="too many robots on each server",
                conditions=(Condition(field="robots_per_server", comparison=">=", limit=robots),),
                samples=cadence.busy,
                steps=(one_more,),
                reason="{robots_per_server:.0f} robots on each server",
            )
        )
    rules.append(
        ScalingRule(
            name="idle",
            meaning="there were no requests, and the servers are idle",
            conditions=(
                Condition(field="requests", comparison="==", limit=0.0),
                Condition(field="cpu_percent", comparison="<", limit=IDLE_CPU_PERCENT),
                *_below_robots(robots),
            ),
            samples=cadence.idle,
            steps=(one_less,),
            reason=f"idle for {settings.idle_s} s",
        )
    )
    if cadence.underused:
        rules.append(
            ScalingRule(
                name="underused",
                meaning="one server fewer can do the work",
                conditions=(
                    Condition(field="cpu_percent", comparison="<", limit=UNDERUSED_CPU_PERCENT),
                    *_below_robots(_SPARE_FRACTION * robots),
                ),
                samples=cadence.underused,
                steps=(one_less,),
                reason="CPU at {cpu_percent:.0f} %, low for " + f"{settings.underused_s} s",
            )
        )
    return tuple(rules)


def _below_robots(limit: float) -> tuple[Condition, ...]:
    """Return the condition that fewer than *limit* robots are on each server; none if the limit is 0."""
    return (Condition(field="robots_per_server", comparison="<", limit=limit),) if limit else ()
