"""The short run of an experiment: ``verify --rerun`` checks with it that the code still reaches its figures.

A report holds the plan of a short run: the arguments, the targets of its figures, and the tolerance of the
targets, since a short run on another machine gives other figures.  This module makes and evaluates plans; it
runs nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.results.bars import Bars, is_met

__all__ = ["RERUN", "FigureReached", "rerun_arguments", "rerun_figures", "rerun_plan"]

RERUN = "rerun"
"""Member of a report that holds the plan."""
# Factor of tolerance for a short run: a "<=" target is multiplied, a ">=" target divided by this factor.
_TOLERANCE_FACTOR = 1.5
# A target in a report, such as "<= 1.5".
_BAR = re.compile(r"(<=|>=) (-?\d+(\.\d+)?(e[-+]?\d+)?)")


@dataclass(frozen=True, slots=True, kw_only=True)
class FigureReached:
    """One figure of a short run, its target ``bar``, and the value ``reported`` for the full run."""

    name: str
    value: Any
    bar: str
    reported: Any
    is_reached: bool

    def __str__(self) -> str:
        """Return the line that is printed: outcome, name, value, target and reported value."""
        outcome = "reached" if self.is_reached else "MISSED"
        return (
            f"{outcome:<7}  {self.name}  {self.value} now, must be {self.bar}; {self.reported} in the report"
        )


def rerun_plan(arguments: Sequence[str], bars: Bars) -> dict[str, Any]:
    """Return the plan for a report: arguments of ``rse-pf experiment KIND``, tolerance and targets."""
    bar_texts = {name: f"{sense} {bar:g}" for name, (bar, sense) in bars.items()}
    return {"arguments": list(arguments), "slack": _TOLERANCE_FACTOR, "bars": bar_texts}


def rerun_arguments(report: Mapping[str, Any]) -> list[str]:
    """Return the arguments of ``rse-pf experiment`` for the short run of *report*.

    Raises UsageError without a plan.
    """
    plan = report.get(RERUN)
    arguments = plan.get("arguments") if isinstance(plan, dict) else None
    if not isinstance(arguments, list) or not all(isinstance(word, str) for word in arguments):
        raise UsageError("the report has no short form", hint="run the experiment again with this version")
    return [str(report.get("experiment")), *arguments]


def rerun_figures(report: Mapping[str, Any], short: Mapping[str, Any]) -> list[FigureReached]:
    """Return for each target in the plan of *report* whether the report *short* of the short run meets it.

    A target names its figure by a path, below ``runs`` if the report has several runs.  Of a figure that is a
    list with a value for each robot, the largest value counts.  A missing figure does not meet its target.

    Raises:
        UsageError: The plan is malformed.
    """
    plan = report[RERUN]
    try:
        slack, bars = float(plan["slack"]), dict(plan["bars"])
        limits = {name: _limit(bar, slack) for name, bar in bars.items()}
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"the short form in the report is damaged: {error}", hint="restore it") from error
    return [
        _check_bar(name, *limit, value=_at(short, name), reported=_at(report, name))
        for name, limit in limits.items()
    ]


def _limit(bar: str, slack: float) -> tuple[str, float]:
    match = _BAR.fullmatch(bar)
    if match is None or slack < 1.0:
        raise ValueError(f"{bar!r} with slack {slack:g} is no target of a figure")
    return match[1], float(match[2]) * (slack if match[1] == "<=" else 1.0 / slack)


def _check_bar(name: str, sense: str, limit: float, *, value: Any, reported: Any) -> FigureReached:
    return FigureReached(
        name=name,
        value=value,
        bar=f"{sense} {limit:g}",
        reported=reported,
        is_reached=is_met(value, sense, limit),
    )


def _at(report: Mapping[str, Any], name: str) -> float | None:
    """Return the number at the path *name* in *report*, or the largest of a list; None if there is none."""
    value: Any = report.get("runs", report)
    for step in name.split("/"):
        value = value.get(step) if isinstance(value, Mapping) else None
    if isinstance(value, list):
        numbers = [number for number in value if isinstance(number, int | float)]
        value = max(numbers) if numbers and len(numbers) == len(value) else None
    return value if isinstance(value, int | float) else None
