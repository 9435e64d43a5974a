"""The comparison of a run's figures with their targets, which reports call bars."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["Bars", "with_bars"]

Bars = Mapping[str, tuple[float, str]]
"""Targets of figures: limit and ``<=`` or ``>=``, by the path of the figure, such as ``gap_s/p99``."""


def with_bars(figures: Mapping[str, Any], bars: Bars) -> dict[str, Any]:
    """Return *figures* with the member ``bars``: value, target and ``held`` (target met) by figure.

    A figure whose value is None does not meet its target.
    """
    return {**figures, "bars": {name: _check_bar(figures, name, *bar) for name, bar in bars.items()}}


def _check_bar(figures: Mapping[str, Any], name: str, bar: float, sense: str) -> dict[str, Any]:
    value: Any = figures
    for step in name.split("/"):
        value = value[step]
    held = value is not None and (value <= bar if sense == "<=" else value >= bar)
    return {"value": value, "bar": f"{sense} {bar:g}", "held": held}
