"""The states of alarms on recorded metrics, row by row as in CloudWatch's guide."""

from __future__ import annotations

import dataclasses

import pytest

from rse_pf.config import ScalingSettings
from rse_pf.scaling.alarms import Alarm, alarms_of
from tests.kit.alarm_states import AlarmRule, State, Value, next_state, replay, value_of

RULE = AlarmRule(
    expression="m", comparison="GreaterThanOrEqualToThreshold", threshold=1.0, periods=3, datapoints=3,
    missing="missing",
)  # fmt: skip
KEPT: State = "OK"
"""The state before; `ignore` keeps it."""
GUIDE_3_OF_3 = {
    "0 - X - X": ("OK", "OK", "OK", "OK"),
    "- - - - 0": ("OK", "OK", "OK", "OK"),
    "- - - - -": ("INSUFFICIENT_DATA", KEPT, "ALARM", "OK"),
    "0 X X - X": ("ALARM", "ALARM", "ALARM", "ALARM"),
    "- - X - -": ("ALARM", KEPT, "ALARM", "OK"),
}
GUIDE_2_OF_3 = {
    "0 - X - X": ("ALARM", "ALARM", "ALARM", "ALARM"),
    "0 0 X 0 X": ("ALARM", "ALARM", "ALARM", "ALARM"),
    "0 - X - -": ("OK", "OK", "ALARM", "OK"),
    "- - - - 0": ("OK", "OK", "ALARM", "OK"),
    "- - - X -": ("ALARM", KEPT, "ALARM", "OK"),
}
TREATMENTS = ("missing", "ignore", "breaching", "notBreaching")
ROWS = [
    (m, points, treatment, expected)
    for m, table in ((3, GUIDE_3_OF_3), (2, GUIDE_2_OF_3))
    for points, states in table.items()
    for treatment, expected in zip(TREATMENTS, states, strict=True)
]


@pytest.mark.parametrize(("datapoints", "points", "treatment", "expected"), ROWS)
def test_missing_data_is_treated_as_in_the_guide(
    datapoints: int, points: str, treatment: str, expected: State
) -> None:
    rule = dataclasses.replace(RULE, datapoints=datapoints, missing=treatment)
    values = [{"0": 0.0, "X": 1.0, "-": None}[each] for each in points.split()]

    assert next_state(rule, values, KEPT) == expected


@pytest.mark.parametrize(
    ("expression", "point", "expected"),
    [
        ("cpu", {"cpu": 3.0}, 3.0),
        ("cpu", {"cpu": None}, None),
        ("IF(requests == 0 AND cpu < 20, 1, 0)", {"requests": 0.0, "cpu": 19.0}, 1.0),
        ("IF(requests == 0 AND cpu < 20, 1, 0)", {"requests": 1.0, "cpu": 19.0}, 0.0),
        ("IF(requests == 0 AND cpu < 20, 1, 0)", {"requests": None, "cpu": 19.0}, None),
        ("FILL(a, 0) - FILL(b, 2)", {"a": None, "b": None}, -2.0),
        ("IF(FILL(wanted, 1) > 0, FILL(errors, 0), 0)", {"wanted": 0.0, "errors": 9.0}, 0.0),
        ("a / b", {"a": 1.0, "b": 0.0}, None),
        ("a != b OR a >= b", {"a": 1.0, "b": 1.0}, 1.0),
    ],
)
def test_an_expression_has_the_value_of_metric_math(
    expression: str, point: dict[str, Value], expected: Value
) -> None:
    assert value_of(expression, point) == expected


def test_the_scaling_alarms_fire_and_resolve_as_the_policy_says() -> None:
    busy, idle = alarms_of(ScalingSettings())[:2]

    def rule(alarm: Alarm) -> AlarmRule:
        return AlarmRule(
            expression=alarm.expression, comparison=alarm.comparison, threshold=alarm.threshold,
            periods=alarm.periods, datapoints=alarm.periods, missing=alarm.missing,
        )  # fmt: skip

    assert replay(rule(busy), {"cpu": [69.9, 70.0, 70.0, 90.0, 69.9]}) == ["OK", "OK", "ALARM", "ALARM", "OK"]
    quiet = {"cpu": [5.0] * 6 + [30.0], "requests": [0.0] * 7}
    assert replay(rule(idle), quiet)[-3:] == ["ALARM", "ALARM", "OK"]
