"""Evaluate CloudWatch alarms on recorded metrics: periods, statistics, metric math, missing data, states.

For tests and experiments without AWS.  It knows what our alarms use and refuses the rest, so that an alarm
that it cannot judge is an error and not a pass.

Source:
    Amazon CloudWatch User Guide, "Configuring how CloudWatch alarms treat missing data" (its two tables are
    rows of tests/scaling/test_alarm_states.py) and "Using math expressions with CloudWatch metrics".
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from rse_pf.errors import UsageError

__all__ = ["AlarmRule", "State", "Value", "next_state", "replay", "statistic", "value_of"]

State = Literal["OK", "ALARM", "INSUFFICIENT_DATA"]
Value = float | None
"""Of one period; None is missing data."""

_MORE_POINTS = 2
"""Periods beyond the evaluated ones that are searched for data, as in the tables of the guide."""
_COMPARISONS = {
    "GreaterThanOrEqualToThreshold": lambda value, threshold: value >= threshold,
    "GreaterThanThreshold": lambda value, threshold: value > threshold,
    "LessThanOrEqualToThreshold": lambda value, threshold: value <= threshold,
    "LessThanThreshold": lambda value, threshold: value < threshold,
}
_TREATMENTS = ("missing", "ignore", "breaching", "notBreaching")


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmRule:
    """When an alarm changes its state: *datapoints* of *periods* values of *expression* breach.

    ``missing`` and ``comparison`` are terms of CloudWatch.
    """

    expression: str
    comparison: str
    threshold: float
    periods: int
    datapoints: int
    missing: str

    def __post_init__(self) -> None:
        if self.comparison not in _COMPARISONS:
            raise _unknown("comparison", self.comparison, _COMPARISONS)
        if self.missing not in _TREATMENTS:
            raise _unknown("treatment of missing data", self.missing, _TREATMENTS)

    def breaches(self, value: float) -> bool:
        """Return whether one value breaches the threshold."""
        return bool(_COMPARISONS[self.comparison](value, self.threshold))


def replay(
    rule: AlarmRule, series: Mapping[str, Sequence[Value]], begin: State = "INSUFFICIENT_DATA"
) -> list[State]:
    """Return the state after each period of *series*: metric name in the expression to its values."""
    length = max(len(values) for values in series.values())
    values: list[Value] = []
    states: list[State] = []
    state = begin
    for at in range(length):
        point = {name: told[at] if at < len(told) else None for name, told in series.items()}
        values.append(value_of(rule.expression, point))
        state = next_state(rule, values, state)
        states.append(state)
    return states


def next_state(rule: AlarmRule, values: Sequence[Value], state: State) -> State:
    """Return the state of the alarm after the newest of *values*, one for each period, oldest first."""
    found = [value for value in values[-(rule.periods + _MORE_POINTS) :] if value is not None]
    real = found[-rule.periods :]
    breaching = sum(rule.breaches(value) for value in real)
    absent = rule.periods - len(real)
    if rule.missing == "breaching":
        breaching += absent
    if breaching >= rule.datapoints:
        return "ALARM"
    if not absent or rule.missing in ("breaching", "notBreaching"):
        return "OK"
    if not real:
        return "INSUFFICIENT_DATA" if rule.missing == "missing" else state
    if breaching < len(real):
        return "OK"
    return "ALARM" if rule.missing == "missing" else state


def statistic(values: Sequence[float], name: str) -> Value:
    """Return the *name* of the samples in one period, None without samples; ``p95`` is a percentile."""
    if not values:
        return None
    if name == "SampleCount":
        return float(len(values))
    if name == "Sum":
        return math.fsum(values)
    if name == "Average":
        return math.fsum(values) / len(values)
    if name in ("Minimum", "Maximum"):
        return min(values) if name == "Minimum" else max(values)
    if name.startswith("p") and name[1:].replace(".", "", 1).isdigit():
        ordered = sorted(values)
        return ordered[max(0, math.ceil(float(name[1:]) / 100 * len(ordered)) - 1)]
    raise _unknown("statistic", name, ("SampleCount", "Sum", "Average", "Minimum", "Maximum", "p95"))


def value_of(expression: str, point: Mapping[str, Value]) -> Value:
    """Return the value of a metric-math expression in one period; a missing operand makes it missing.

    Raises:
        UsageError: The expression uses what is not implemented here, or a metric that *point* lacks.
    """
    text = expression.replace(" AND ", " and ").replace(" OR ", " or ")
    try:
        return _value(ast.parse(text, mode="eval").body, point)
    except (SyntaxError, KeyError) as error:
        raise UsageError(
            f"cannot evaluate {expression!r}: {error}", hint="use IF, FILL, AND, < and +"
        ) from error


def _value(node: ast.expr, point: Mapping[str, Value]) -> Value:
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return float(node.value)
    if isinstance(node, ast.Name):
        return point[node.id]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return _called(node.func.id, node.args, point)
    if isinstance(node, ast.BoolOp):
        told = [_value(each, point) for each in node.values]
        if None in told:
            return None
        return float(all(told) if isinstance(node.op, ast.And) else any(told))
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        return _compared(node.ops[0], _value(node.left, point), _value(node.comparators[0], point))
    if isinstance(node, ast.BinOp):
        return _computed(node.op, _value(node.left, point), _value(node.right, point))
    raise KeyError(ast.unparse(node))


def _called(name: str, arguments: Sequence[ast.expr], point: Mapping[str, Value]) -> Value:
    told = [_value(each, point) for each in arguments]
    if name == "FILL" and len(told) == 2:
        return told[1] if told[0] is None else told[0]
    if name == "IF" and len(told) == 3:
        return None if told[0] is None else told[1] if told[0] else told[2]
    raise KeyError(f"{name} of {len(told)} arguments")


def _compared(op: ast.cmpop, left: Value, right: Value) -> Value:
    if left is None or right is None:
        return None
    found = {
        ast.Lt: left < right, ast.LtE: left <= right, ast.Gt: left > right, ast.GtE: left >= right,
        ast.Eq: left == right, ast.NotEq: left != right,
    }.get(type(op))  # fmt: skip
    if found is None:
        raise KeyError(type(op).__name__)
    return float(found)


def _computed(op: ast.operator, left: Value, right: Value) -> Value:
    if left is None or right is None:
        return None
    if isinstance(op, ast.Div):
        return left / right if right else None
    found = {ast.Add: left + right, ast.Sub: left - right, ast.Mult: left * right}.get(type(op))
    if found is None:
        raise KeyError(type(op).__name__)
    return found


def _unknown(what: str, given: str, known: Sequence[str] | Mapping[str, object]) -> UsageError:
    return UsageError(f"unknown {what} {given!r}", hint=f"one of {', '.join(known)}")
