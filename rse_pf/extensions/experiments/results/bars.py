"""The comparison of a run's figures with their targets, which reports call bars."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rse_pf.extensions.experiments.results.markdown import number, table

__all__ = ["Bars", "bars_blocks", "is_met", "missed_bars", "with_bars"]

Bars = Mapping[str, tuple[float, str]]
"""Targets of figures: limit and ``<=`` or ``>=``, by the path of the figure, such as ``gap_s/p99``."""


def with_bars(figures: Mapping[str, Any], bars: Bars) -> dict[str, Any]:
    """Return *figures* with the member ``bars``: value, target and ``held`` (target met) by figure.

    A figure whose value is None does not meet its target.
    """
    return {**figures, "bars": {name: _check_bar(figures, name, *bar) for name, bar in bars.items()}}


def is_met(value: Any, sense: str, limit: float) -> bool:
    """Return whether *value* is at most (``<=``) or at least (``>=``) *limit*; None never meets a limit."""
    return value is not None and bool(value <= limit if sense == "<=" else value >= limit)


def missed_bars(figures: Mapping[str, Any]) -> list[str]:
    """Return the paths of the figures that miss their targets, by the member ``bars`` of `with_bars`."""
    return [name for name, bar in figures["bars"].items() if not bar["held"]]


def bars_blocks(runs: Mapping[str, Mapping[str, Any]]) -> tuple[str, list[str]]:
    """Return for a page how many targets of *runs* were met, and the table of all targets."""
    rows = [
        [name, figure, number(bar["value"]), bar["bar"], "met" if bar["held"] else "**missed**"]
        for name, run in runs.items()
        for figure, bar in run["bars"].items()
    ]
    met = sum(row[-1] == "met" for row in rows)
    return f"{met} of {len(rows)} targets met.", table(["fault", "figure", "measured", "target", ""], rows)


def _check_bar(figures: Mapping[str, Any], name: str, bar: float, sense: str) -> dict[str, Any]:
    value: Any = figures
    for step in name.split("/"):
        value = value[step]
    return {"value": value, "bar": f"{sense} {bar:g}", "held": is_met(value, sense, bar)}
