"""Figures of a run compared with the bars that they must meet."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["Bars", "with_bars"]

Bars = Mapping[str, tuple[float, str]]
"""Path of a figure, as ``gap_s/p99``, to its bar and ``<=`` or ``>=``."""


def with_bars(figures: Mapping[str, Any], bars: Bars) -> dict[str, Any]:
    """Return *figures* with ``bars``: value, bar and ``held`` of each.

    A figure without a value, None, does not hold.
    """
    return {**figures, "bars": {name: _judge(figures, name, *bar) for name, bar in bars.items()}}


def _judge(figures: Mapping[str, Any], name: str, bar: float, sense: str) -> dict[str, Any]:
    value: Any = figures
    for step in name.split("/"):
        value = value[step]
    held = value is not None and (value <= bar if sense == "<=" else value >= bar)
    return {"value": value, "bar": f"{sense} {bar:g}", "held": held}
