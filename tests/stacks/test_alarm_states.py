"""Every alarm of the templates, on replayed metrics: quiet while all is well, ALARM on its fault, then OK.

The alarms are parsed from the templates, and evaluated by `tests.kit.alarm_states`.  A sample is what a
service of AWS or an agent publishes in one period; the statistic is made of the samples of a period.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from rse_pf.auth.roster import SYNTHETIC
from rse_pf.config import PlatformSettings
from rse_pf.scaling.alarms import CPU
from rse_pf.scaling.operator_alarms import operator_alarms
from rse_pf.scaling.profile import cadence_of
from tests.kit.alarm_states import AlarmRule, State, Value, replay, statistic
from tests.kit.fleet_traffic import Robot, measure_traffic

Assembly = Any
Period = Mapping[str, Sequence[float]]
"""Metric name to the samples of one period; a name that is absent has no data."""

CANARY = Robot(name="rse-pf-canary", scopes=("services:pnp", "services:echo", SYNTHETIC))
MORE = 3
"""Periods of a fault beyond those that the alarm needs."""


def alarms_in(assembly: Assembly) -> dict[str, dict[str, Any]]:
    """Return the properties of every alarm by its short name."""
    return {each["AlarmName"].rpartition("/")[2]: each for each in assembly.all("AWS::CloudWatch::Alarm")}


def states(alarm: dict[str, Any], periods: Sequence[Period]) -> list[State]:
    """Return the state after each period, judged as CloudWatch does."""
    *queries, verdict = alarm["Metrics"]
    assert verdict["ReturnData"] is True
    series: dict[str, list[Value]] = {
        query["Id"]: [
            statistic(
                period.get(query["MetricStat"]["Metric"]["MetricName"], ()), query["MetricStat"]["Stat"]
            )
            for period in periods
        ]
        for query in queries
    }
    rule = AlarmRule(
        expression=verdict["Expression"], comparison=alarm["ComparisonOperator"],
        threshold=alarm["Threshold"], periods=alarm["EvaluationPeriods"],
        datapoints=alarm["DatapointsToAlarm"], missing=alarm["TreatMissingData"],
    )  # fmt: skip
    return replay(rule, series, "OK")


def well(assembly: Assembly, period_s: int) -> dict[str, list[float]]:
    """Return a period in which nothing is wrong, with the smallest fleet and some load."""
    floor = float(assembly.settings.scaling.min_servers)
    reports = int(floor) * (period_s // cadence_of(assembly.settings.scaling).period_s)
    return {
        "HealthyHostCount": [floor] * 3, "UnHealthyHostCount": [0.0] * 3,
        "GroupDesiredCapacity": [floor], "GroupInServiceInstances": [floor],
        "HTTPCode_Target_5XX_Count": [0.0], "HTTPCode_ELB_5XX_Count": [0.0],
        "Robots": [4.0] * reports, "Requests": [200.0], "CPUUtilization": [40.0, 50.0],
        CPU: [40.0], "BlockedRequests": [1.0],
        "Invocations": [1.0], "Errors": [0.0], "Throttles": [0.0], "Duration": [300.0, 400.0],
    }  # fmt: skip


def without(period: Period, *names: str) -> dict[str, Sequence[float]]:
    return {name: samples for name, samples in period.items() if name not in names}


FAULTS: dict[str, list[dict[str, list[float] | None]]] = {
    "few-servers": [
        {"HealthyHostCount": [1.0, 0.0]},
        {"HealthyHostCount": None},  # no target is registered: the target group publishes nothing
        {"HealthyHostCount": None, "GroupDesiredCapacity": None},  # the group is gone, too
    ],
    "unhealthy": [{"UnHealthyHostCount": [0.0, 1.0]}],
    "errors": [{"HTTPCode_Target_5XX_Count": [1.0]}],
    "balancer-errors": [
        {"HTTPCode_ELB_5XX_Count": [40.0]},
        {"HTTPCode_ELB_5XX_Count": [40.0], "GroupDesiredCapacity": None},
    ],
    "silent-agent": [{"Robots": None}, {"Robots": "one server less"}],  # type: ignore[dict-item]
    "native-crashes": [{"NativeCrashes": [1.0]}, {"NativeCrashes": [1.0, 2.0], "Robots": None}],
    "disk": [{"DiskLow": [1.0]}],
    "lambda-errors": [{"Errors": [1.0]}],
    "lambda-throttles": [{"Throttles": [3.0]}],
    "lambda-slow": [{"Duration": [9000.0, 9500.0]}],
    "blocked": [{"BlockedRequests": [500.0]}],
    "store": [{"StoreErrors": [1.0, 1.0]}, {"StoreErrors": [1.0], "Robots": None}],
    "canary": [{"Errors": [1.0]}, {"Invocations": None, "Errors": None}, {"Invocations": None}],
    "busy": [{"CPUUtilization": [99.0], CPU: [99.0]}],
    "idle": [{"Requests": [0.0], "CPUUtilization": [2.0], CPU: [2.0]}],
    "underused": [{"CPUUtilization": [2.0], CPU: [2.0], "Robots": [1.0]}],
    "crowded": [{"Robots": [1e4]}],
}
"""Alarm to its faults: what a fault changes in a period; None is missing data."""
QUIET_WHEN_PARKED = ("few-servers", "balancer-errors", "silent-agent", "canary", "unhealthy", "store")


def broken(assembly: Assembly, name: str, fault: Mapping[str, Any], period_s: int) -> Period:
    period: dict[str, Sequence[float]] = dict(well(assembly, period_s))
    for metric, samples in fault.items():
        if samples is None:
            del period[metric]
        elif samples == "one server less":
            servers = assembly.settings.scaling.min_servers
            period[metric] = period[metric][: len(period[metric]) * (servers - 1) // servers]
        else:
            period[metric] = samples
    return period


def test_every_alarm_of_the_templates_has_a_fault_here(assembly: Assembly) -> None:
    assert set(alarms_in(assembly)) <= set(FAULTS)
    assert {each.name for each in operator_alarms(assembly.settings)} <= set(alarms_in(assembly))


@pytest.mark.parametrize(("name", "number"), [(name, i) for name in FAULTS for i in range(len(FAULTS[name]))])
def test_an_alarm_is_quiet_fires_on_its_fault_and_resolves(
    assembly: Assembly, name: str, number: int
) -> None:
    alarm = alarms_in(assembly).get(name)
    if alarm is None:
        pytest.skip(f"{name} is not switched on in these settings")
    period_s, needed = alarm["Metrics"][0]["MetricStat"]["Period"], alarm["EvaluationPeriods"]
    quiet = well(assembly, period_s)
    fault = broken(assembly, name, FAULTS[name][number], period_s)
    before, during, after = [quiet] * (needed + MORE), [fault] * (needed + MORE), [quiet] * (needed + MORE)

    told = states(alarm, [*before, *during, *after])

    begin, end = len(before), len(before) + len(during)
    assert set(told[:begin]) == {"OK"}
    assert told[end - 1] == "ALARM"
    assert told.index("ALARM") - begin < needed + 2, (
        "it fires within its periods, and those that AWS searches"
    )
    assert told[-1] == "OK"


@pytest.mark.parametrize("sample_s", [10, 60, 120, 600])
@pytest.mark.parametrize(
    ("name", "quiet", "wrong"),
    [("disk", {}, {"low": 1.0}), ("silent-agent", {"reports": 2.0}, {"reports": 1.0})],
)
def test_an_alarm_of_what_agents_publish_fires_whatever_their_period_is(
    sample_s: int, name: str, quiet: Mapping[str, float], wrong: Mapping[str, float]
) -> None:
    settings = PlatformSettings.from_dict({"scaling": {"period_s": sample_s, "idle_s": 600}})
    (alarm,) = [each for each in operator_alarms(settings) if each.name == name]
    rule = AlarmRule(
        expression=alarm.expression, comparison=alarm.comparison, threshold=alarm.threshold,
        periods=alarm.periods, datapoints=alarm.datapoints, missing=alarm.missing,
    )  # fmt: skip
    hour = range(0, 3600, sample_s)

    def after(published: Mapping[str, float]) -> State:
        """Return the state at the end of an hour; *published* is the sum of two servers in each sample."""
        series: dict[str, list[Value]] = {"serving": [2.0] * (3600 // alarm.period_s)}
        for metric in {*quiet, *wrong}:
            buckets: list[Value] = [None] * (3600 // alarm.period_s)
            for at in hour if metric in published else ():
                bucket = at // alarm.period_s
                buckets[bucket] = published[metric] + (buckets[bucket] or 0.0)
            series[metric] = buckets
        return replay(rule, series, "OK")[-1]

    assert (after(quiet), after(wrong)) == ("OK", "ALARM")


@pytest.mark.parametrize("name", QUIET_WHEN_PARKED)
def test_a_parked_platform_has_no_servers_on_purpose(assembly: Assembly, name: str) -> None:
    nothing = {"GroupDesiredCapacity": [0.0], "GroupInServiceInstances": [0.0], "Invocations": [1.0],
               "Errors": [1.0], "HTTPCode_ELB_5XX_Count": [9.0]}  # fmt: skip

    assert set(states(alarms_in(assembly)[name], [nothing] * 20)) == {"OK"}


def test_each_operator_alarm_tells_the_topic_when_it_fires_and_when_it_resolves(assembly: Assembly) -> None:
    alarms = alarms_in(assembly)
    for alarm in operator_alarms(assembly.settings):
        assert len(alarms[alarm.name]["AlarmActions"]) == 1
        assert alarms[alarm.name]["AlarmActions"] == alarms[alarm.name]["OKActions"]


def test_the_budget_tells_the_topic_before_it_is_spent(assembly: Assembly) -> None:
    budgets = assembly.all("AWS::Budgets::Budget")

    if not assembly.settings.cloud.budget_per_month:
        assert budgets == []
        return
    (budget,) = budgets
    assert budget["Budget"]["BudgetLimit"] == {
        "Amount": assembly.settings.cloud.budget_per_month, "Unit": "USD",
    }  # fmt: skip
    told = budget["NotificationsWithSubscribers"]
    rules = [each["Notification"] for each in told]
    assert [(each["NotificationType"], each["Threshold"]) for each in rules] == [
        ("ACTUAL", 80), ("FORECASTED", 100),
    ]  # fmt: skip
    assert {each["Subscribers"][0]["SubscriptionType"] for each in told} == {"SNS"}


@pytest.mark.parametrize(
    ("robots", "is_idle"),
    [
        ([CANARY], True),
        ([CANARY, Robot(name="r")], False),
        ([CANARY, Robot(name="r", active=(2, 7, 12))], False),
    ],
    ids=["canary", "canary-and-robot", "canary-and-rare-robot"],
)
def test_the_canary_does_not_keep_ten_servers(
    assembly: Assembly, robots: Sequence[Robot], is_idle: bool
) -> None:
    alarm = alarms_in(assembly)["idle"]
    needed = alarm["EvaluationPeriods"]
    unloaded = {"Requests": 0.0, "Robots": 0.0}
    traffic = measure_traffic(robots, needed + MORE)
    periods = [
        {
            **{name: [one.cloud[name], *[unloaded[name]] * 9] for name in unloaded},
            "CPUUtilization": [17.0] * 10, CPU: [17.0] * 10,
        }
        for one in traffic
    ]  # fmt: skip

    told = states(alarm, periods)
    assert told[: needed - 1] == ["OK"] * (needed - 1)
    assert ("ALARM" in told) is is_idle
    assert set(states(alarm, [without(period, "Requests") for period in periods])) == {"OK"}
