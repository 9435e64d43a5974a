"""The law: `decide` and CloudWatch, with the alarms of `alarms_of`, do the same on any load.

`Cloud` follows Amazon's documents: an alarm goes by its last N datapoints; a step policy runs when its alarm
begins to stand and then once each minute; the newest datapoint chooses the step; instances in their warm-up
do not count as capacity when growing and block shrinking; the policy that asks for most wins.
"""

from __future__ import annotations

import dataclasses
import itertools
import operator
import re

import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from rse_pf.config import ScalingSettings
from rse_pf.scaling.alarms import NAMESPACE, Alarm, alarms_of
from rse_pf.scaling.policy import FleetState, decide, find_rule_starts
from rse_pf.scaling.profile import cadence_of
from rse_pf.scaling.rules import Sample

Point = dict[str, float] | None
Run = list[int]


def value(alarm: Alarm, point: Point) -> float | None:
    """Evaluate the alarm's expression on one period; None is missing data."""
    if point is None:
        return None
    if alarm.expression in point:
        return point[alarm.expression]
    found = re.fullmatch(r"IF\((.+), 1, 0\)", alarm.expression)
    assert found is not None
    conditions = [condition.split() for condition in found[1].split(" AND ")]
    assert {name for name, _, _ in conditions} == {metric.name for metric in alarm.metrics}
    compare = {"==": operator.eq, "<": operator.lt}
    return float(all(compare[sign](point[name], float(limit)) for name, sign, limit in conditions))


class Cloud:
    """CloudWatch and an Auto Scaling group."""

    def __init__(self, alarms: tuple[Alarm, ...], scaling: ScalingSettings) -> None:
        self.alarms, self.scaling = alarms, scaling
        self.launched = [-1e9] * scaling.min_servers
        self.points: list[Point] = []
        self.stands_since_s: dict[str, float] = {}

    def warm(self, now_s: float) -> int:
        return sum(now_s - each >= self.scaling.warm_up_s for each in self.launched)

    def period(self, point: Point, now_s: float) -> None:
        self.points.append(point)
        wishes = [wish for alarm in self.alarms if (wish := self._wish(alarm, now_s)) is not None]
        if wishes:
            desired = max(self.scaling.min_servers, min(self.scaling.max_servers, max(wishes)))
            self.launched += [now_s] * (desired - len(self.launched))
            del self.launched[desired:]

    def _wish(self, alarm: Alarm, now_s: float) -> int | None:
        values = [value(alarm, point) for point in self.points[-alarm.periods :]]
        stands = len(values) == alarm.periods and all(
            each is not None and each >= alarm.threshold for each in values
        )
        if not stands:
            self.stands_since_s.pop(alarm.name, None)
            return None
        stands_s = now_s - self.stands_since_s.setdefault(alarm.name, now_s)
        if alarm.period_s < 60 and stands_s % 60:
            return None
        assert alarm.missing == "notBreaching"
        newest = values[-1]
        assert newest is not None
        above = newest - alarm.threshold
        change = next(
            step.change
            for step in alarm.steps
            if (step.lower is None or above >= step.lower) and (step.upper is None or above < step.upper)
        )
        if change > 0:
            return max(len(self.launched), self.warm(now_s) + change)
        return len(self.launched) + (change if self.warm(now_s) == len(self.launched) else 0)


class Local:
    """The local platform's loop around `decide`, which keeps only so many samples as it must."""

    def __init__(self, scaling: ScalingSettings) -> None:
        self.scaling = scaling
        self.cadence = cadence_of(scaling)
        self.since_s: dict[str, float] = {}
        self.launched = [-1e9] * scaling.min_servers
        self.samples: list[Sample] = []

    def period(self, point: Point, now_s: float) -> None:
        if point is not None:
            self.samples.append(
                Sample(
                    start_s=now_s - self.cadence.period_s,
                    cpu_percent=point["cpu"],
                    requests=point["requests"],
                    robots_per_server=point["robots"],
                )
            )
        warming = sum(now_s - each < self.scaling.warm_up_s for each in self.launched)
        fleet = FleetState(servers=len(self.launched), warming=warming)
        del self.samples[: -self.cadence.most - 1]
        self.since_s = find_rule_starts(self.samples, self.scaling, now_s=now_s, before=self.since_s)
        (action,) = decide(self.samples, fleet, self.scaling, now_s=now_s, since_s=self.since_s)
        if action.kind == "grow":
            self.launched += [now_s] * action.servers
        elif action.kind == "shrink":
            del self.launched[len(self.launched) - action.servers :]


def run(side: Cloud | Local, loads: list[float | None], *, closed_loop: bool) -> Run:
    """Return the number of servers after each period of a load, in per cent of one server."""
    trace = []
    for i, load in enumerate(loads):
        now_s = (i + 1) * float(cadence_of(side.scaling).period_s)
        point = None
        if load is not None:
            shared = load / len(side.launched) if closed_loop else load
            point = {
                "cpu": min(100.0, shared), "requests": load, "robots": shared,
            }  # fmt: skip
        side.period(point, now_s)
        trace.append(len(side.launched))
    return trace


@st.composite
def walks(draw: st.DrawFn) -> list[float | None]:
    """Random walks with plateaus on and beside every threshold, rests, and gaps."""
    loads: list[float | None] = []
    longest = draw(st.sampled_from([8, 40]))
    for _ in range(draw(st.integers(1, 8))):
        level = draw(
            st.one_of(
                st.sampled_from([0.0, 14.9, 15.0, 19.9, 20.0, 69.9, 70.0, 84.9, 85.0, 100.0]),
                st.floats(0, 900).map(lambda each: round(each, 1)),
                st.none(),
            )
        )
        loads += [level] * draw(st.integers(1, longest))
    return loads


SCALINGS = st.builds(
    lambda profile, idle_s, underused_s, low, more, warm, robots: ScalingSettings(
        profile=profile, idle_s=idle_s, underused_s=underused_s, min_servers=low, max_servers=low + more,
        warm_up_s=warm, max_robots_per_server=robots,
    ),
    st.sampled_from(["paper", "fast"]), st.sampled_from([60, 180, 300]), st.sampled_from([0, 120, 900]),
    st.integers(1, 3), st.integers(0, 8), st.sampled_from([0, 30, 60, 90, 180]),
    st.sampled_from([0, 60]),
)  # fmt: skip


@seed(20261121)
@settings(max_examples=200)
@given(loads=walks(), scaling=SCALINGS, closed_loop=st.booleans())
def test_the_policy_and_the_cloud_alarms_agree_on_any_load(
    loads: list[float | None], scaling: ScalingSettings, closed_loop: bool
) -> None:
    cloud = run(Cloud(alarms_of(scaling), scaling), loads, closed_loop=closed_loop)
    local = run(Local(scaling), loads, closed_loop=closed_loop)

    assert local == cloud


LOADS: list[float | None] = [
    70.0,
    70.0,
    90.0,
    90.0,
    70.0,
    20.0,
    *[0.0] * 4,
    None,
    *[0.0] * 12,
    69.9,
    *[85.0] * 12,
    *[14.9] * 30,
    *[0.0] * 30,
    15.0,
    *[14.9] * 20,
    *[70.0] * 4,
]
MUTATED = {
    "paper": ScalingSettings(min_servers=1, underused_s=900),
    "fast": ScalingSettings(min_servers=1, profile="fast", idle_s=60, underused_s=200),
}


def _changed(alarm: Alarm, what: str) -> Alarm:
    if what == "higher":
        return dataclasses.replace(alarm, threshold=alarm.threshold + 0.5)
    if what == "lower":
        return dataclasses.replace(alarm, threshold=alarm.threshold - 0.5)
    if what in ("longer", "shorter"):
        return dataclasses.replace(alarm, periods=alarm.periods + (1 if what == "longer" else -1))
    if what == "one step":
        return dataclasses.replace(alarm, steps=alarm.steps[-1:]) if len(alarm.steps) > 1 else alarm
    if what == "each period":  # it repeats its action, instead of each minute
        return dataclasses.replace(alarm, period_s=60)
    if what == "twice as much":
        steps = tuple(dataclasses.replace(step, change=step.change * 2) for step in alarm.steps)
        return dataclasses.replace(alarm, steps=steps)
    old, new = what.split("|")
    return dataclasses.replace(alarm, expression=alarm.expression.replace(old, new))


@pytest.mark.parametrize(
    ("what", "profile"),
    [
        *itertools.product(
            (
                "higher", "lower", "longer", "shorter", "one step", "twice as much",
                "cpu < 20|cpu < 0", "cpu < 15|cpu < 14", "requests == 0 AND |",
            ),
            ("paper", "fast"),
        ),
        ("each period", "fast"),
    ],
)  # fmt: skip
def test_an_alarm_that_says_something_else_breaks_the_law(what: str, profile: str) -> None:
    scaling = MUTATED[profile]
    honest = run(Cloud(alarms_of(scaling), scaling), LOADS, closed_loop=False)
    mutated = []
    for alarm in alarms_of(scaling):
        other = _changed(alarm, what)
        if "|" in what:  # the expression forgets a metric, or has another limit
            metrics = tuple(each for each in other.metrics if each.name in other.expression)
            other = dataclasses.replace(other, metrics=metrics)
        mutated.append(other)
    try:
        changed = run(Cloud(tuple(mutated), scaling), LOADS, closed_loop=False)
    except StopIteration:
        return

    assert run(Local(scaling), LOADS, closed_loop=False) == honest
    assert changed != honest


def test_the_alarms_of_the_papers_profile_have_the_papers_numbers() -> None:
    busy, idle, underused = alarms_of(ScalingSettings())

    assert (busy.threshold, busy.periods, busy.period_s) == (70.0, 2, 60)
    assert [(step.lower, step.upper, step.change) for step in busy.steps] == [(0, 15, 1), (15, None, 2)]
    assert (idle.periods, idle.period_s, idle.steps[0].change) == (5, 60, -1)
    assert idle.expression == "IF(requests == 0 AND cpu < 20, 1, 0)"
    assert (underused.periods, underused.period_s, underused.expression) == (15, 60, "IF(cpu < 15, 1, 0)")


def test_the_fast_profile_needs_three_samples_of_ten_seconds_of_the_servers_own_metrics() -> None:
    alarms = {alarm.name: alarm for alarm in alarms_of(ScalingSettings(profile="fast"))}

    assert (alarms["busy"].period_s, alarms["busy"].periods) == (10, 3)
    assert (alarms["idle"].period_s, alarms["idle"].periods) == (10, 30)
    assert {metric.namespace for alarm in alarms.values() for metric in alarm.metrics} == {NAMESPACE}


def test_limits_that_are_on_keep_servers_that_they_would_add_again() -> None:
    scaling = ScalingSettings(max_robots_per_server=60)
    expressions = {alarm.name: alarm.expression for alarm in alarms_of(scaling)}

    assert expressions["idle"] == "IF(requests == 0 AND cpu < 20 AND robots < 60, 1, 0)"
    assert expressions["underused"] == "IF(cpu < 15 AND robots < 30, 1, 0)"
