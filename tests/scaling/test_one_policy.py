"""The law: `decide` and CloudWatch, with the alarms of `alarms_of`, do the same on any load.

`Cloud` follows Amazon's documents: an alarm goes by its last N datapoints; a step policy runs in every
period in which its alarm stands; the newest datapoint chooses the step; instances in their warm-up do not
count as capacity when growing and block shrinking; the policy that asks for most wins.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from rse_pf.config import ScalingSettings
from rse_pf.scaling.alarms import Alarm, alarms_of
from rse_pf.scaling.policy import FleetState, Sample, decide

Point = dict[str, float] | None
Run = list[int]


def value(alarm: Alarm, point: Point) -> float | None:
    """Evaluate the alarm's expression on one period; None is missing data."""
    if point is None:
        return None
    if alarm.expression in point:
        return point[alarm.expression]
    idle_below = float(alarm.expression.partition("cpu < ")[2].partition(",")[0])
    assert alarm.expression == f"IF(requests == 0 AND cpu < {idle_below:g}, 1, 0)"
    return 1.0 if point["requests"] == 0 and point["cpu"] < idle_below else 0.0


class Cloud:
    """CloudWatch and an Auto Scaling group."""

    def __init__(self, alarms: tuple[Alarm, ...], scaling: ScalingSettings) -> None:
        self.alarms, self.scaling = alarms, scaling
        self.launched = [-1e9] * scaling.min_servers
        self.points: list[Point] = []

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
    """The local platform's loop around `decide`."""

    def __init__(self, scaling: ScalingSettings) -> None:
        self.scaling = scaling
        self.launched = [-1e9] * scaling.min_servers
        self.samples: list[Sample] = []

    def period(self, point: Point, now_s: float) -> None:
        if point is not None:
            self.samples.append(
                Sample(
                    start_s=now_s - self.scaling.period_s,
                    cpu_percent=point["cpu"],
                    requests=point["requests"],
                    robots_per_server=point["robots"],
                    queue_ms=point["queue"],
                )
            )
        warming = sum(now_s - each < self.scaling.warm_up_s for each in self.launched)
        fleet = FleetState(servers=len(self.launched), warming=warming)
        (action,) = decide(self.samples, fleet, self.scaling, now_s=now_s)
        if action.kind == "grow":
            self.launched += [now_s] * action.servers
        elif action.kind == "shrink":
            del self.launched[len(self.launched) - action.servers :]


def run(side: Cloud | Local, loads: list[float | None], *, closed_loop: bool) -> Run:
    """Return the number of servers after each period of a load, in per cent of one server."""
    trace = []
    for i, load in enumerate(loads):
        now_s = (i + 1) * float(side.scaling.period_s)
        point = None
        if load is not None:
            shared = load / len(side.launched) if closed_loop else load
            point = {
                "cpu": min(100.0, shared), "requests": load, "robots": shared, "queue": shared / 2,
            }  # fmt: skip
        side.period(point, now_s)
        trace.append(len(side.launched))
    return trace


@st.composite
def walks(draw: st.DrawFn) -> list[float | None]:
    """Random walks with plateaus on and beside every threshold, rests, and gaps."""
    loads: list[float | None] = []
    for _ in range(draw(st.integers(1, 8))):
        level = draw(
            st.one_of(
                st.sampled_from([0.0, 19.9, 20.0, 69.9, 70.0, 84.9, 85.0, 100.0]),
                st.floats(0, 900).map(lambda each: round(each, 1)),
                st.none(),
            )
        )
        loads += [level] * draw(st.integers(1, 8))
    return loads


SCALINGS = st.builds(
    lambda low, more, warm, busy, robots, queue: ScalingSettings(
        min_servers=low, max_servers=low + more, warm_up_s=warm, busy_periods=busy,
        max_robots_per_server=robots, max_queue_ms=queue,
    ),
    st.integers(1, 3), st.integers(0, 8), st.sampled_from([0, 30, 60, 90, 180]), st.integers(1, 3),
    st.sampled_from([0, 60]), st.sampled_from([0.0, 32.0]),
)  # fmt: skip


@seed(20261121)
@settings(max_examples=300)
@given(loads=walks(), scaling=SCALINGS, closed_loop=st.booleans())
def test_the_policy_and_the_cloud_alarms_agree_on_any_load(
    loads: list[float | None], scaling: ScalingSettings, closed_loop: bool
) -> None:
    cloud = run(Cloud(alarms_of(scaling), scaling), loads, closed_loop=closed_loop)
    local = run(Local(scaling), loads, closed_loop=closed_loop)

    assert local == cloud


def _other(change: Callable[[Alarm], Alarm]) -> tuple[Alarm, ...]:
    return tuple(change(alarm) for alarm in alarms_of(ScalingSettings()))


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
    85.0,
    85.0,
]


@pytest.mark.parametrize(
    "mutate",
    [
        lambda alarm: dataclasses.replace(alarm, threshold=alarm.threshold + 0.5),
        lambda alarm: dataclasses.replace(alarm, threshold=alarm.threshold - 0.5),
        lambda alarm: dataclasses.replace(alarm, periods=alarm.periods + 1),
        lambda alarm: dataclasses.replace(alarm, periods=alarm.periods - 1),
        lambda alarm: dataclasses.replace(alarm, steps=alarm.steps[-1:]) if len(alarm.steps) > 1 else alarm,
        lambda alarm: dataclasses.replace(
            alarm, steps=tuple(dataclasses.replace(step, change=step.change * 2) for step in alarm.steps)
        ),
        lambda alarm: dataclasses.replace(alarm, expression=alarm.expression.replace("cpu < 20", "cpu < 0")),
    ],
)
def test_an_alarm_that_says_something_else_breaks_the_law(mutate: Callable[[Alarm], Alarm]) -> None:
    scaling = ScalingSettings()
    honest = run(Cloud(alarms_of(scaling), scaling), LOADS, closed_loop=False)
    try:
        changed = run(Cloud(_other(mutate), scaling), LOADS, closed_loop=False)
    except StopIteration:
        return

    assert run(Local(scaling), LOADS, closed_loop=False) == honest
    assert changed != honest


def test_the_busy_alarm_has_the_papers_numbers() -> None:
    busy, idle = alarms_of(ScalingSettings())

    assert (busy.threshold, busy.periods, busy.period_s) == (70.0, 2, 60)
    assert [(step.lower, step.upper, step.change) for step in busy.steps] == [(0, 15, 1), (15, None, 2)]
    assert (idle.periods, idle.period_s, idle.steps[0].change) == (5, 60, -1)
