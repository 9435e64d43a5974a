"""The rules of scaling as one table: what is compared, for how many samples in a row, and what then changes.

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

# Servers added above `scaling.busy_cpu_percent`: the least change, as in the paper.
STEP = 1
# Servers added above `scaling.very_busy_cpu_percent`: one would be busy again after its warm-up.
BIG_STEP = 2
# Share of `scaling.max_robots_per_server` below which a server may be removed although robots send commands:
# when one of two servers leaves, the other one gets twice as many robots.
_SPARE_SHARE = 0.5

Field = Literal["cpu_percent", "requests", "robots_per_server"]
"""A field of a `Sample` that a rule may compare."""
_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge, "<": operator.lt, "==": operator.eq,
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """Measurements of one whole period, over all servers that are past their warm-up.

    ``start_s`` is the start of the period, so a sample covers ``[start_s, start_s + period)``.
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
    """How many servers to add while a value is in ``[lower, upper)`` above its limit; None: no bound."""

    lower: float | None
    upper: float | None
    change: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingRule:
    """Conditions on *samples* samples in a row, and by how many servers they change the fleet.

    Attributes:
        name: Also the name of the alarm, and of its chapter in docs/operations.md.
        meaning: For the description of the alarm.
        conditions: All of them must hold.
        samples: In a row.
        steps: Changes by the distance of the first condition's field from its limit.
        reason: For the log; fields of the newest `Sample` in braces.
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
        """Return the change of the number of servers for a *sample* that meets the conditions."""
        above = getattr(sample, self.conditions[0].field) - self.conditions[0].limit
        return next(step.change for step in self.steps if step.upper is None or above < step.upper)

    def explain(self, sample: Sample) -> str:
        """Return the reason, with the numbers of *sample*."""
        return self.reason.format(**asdict(sample))


def rules_of(settings: ScalingSettings) -> tuple[ScalingRule, ...]:
    """Return the rules that *settings* switch on, those that add servers first.

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
                    *_below_robots(_SPARE_SHARE * robots),
                ),
                samples=cadence.underused,
                steps=(one_less,),
                reason="CPU at {cpu_percent:.0f} %, low for " + f"{settings.underused_s} s",
            )
        )
    return tuple(rules)


def _below_robots(limit: float) -> tuple[Condition, ...]:
    """Return the condition on robots of a rule that removes a server; none without a limit on robots."""
    return (Condition(field="robots_per_server", comparison="<", limit=limit),) if limit else ()
