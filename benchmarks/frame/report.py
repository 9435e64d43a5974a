"""The report of a benchmark: its figures against the bars, on the screen and as JSON."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["Bar", "judge", "say", "show", "write"]


@dataclass(frozen=True, slots=True)
class Bar:
    """What a figure must hold: a number at most or at least, or one value.

    *figure* is its path in the figures, with dots between keys; ``*`` stands for every key or row, of which
    the worst one is judged.  A figure that is not there was not measured, which misses nothing; None and NaN
    miss the bar.
    """

    figure: str
    at_most: float | None = None
    at_least: float | None = None
    equals: Any = None
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.figure} {self.limit}"

    @property
    def limit(self) -> str:
        """The limit as text."""
        if self.at_most is not None:
            return f"<= {self.at_most:g} {self.unit}".strip()
        if self.at_least is not None:
            return f">= {self.at_least:g} {self.unit}".strip()
        return f"= {self.equals}"

    @property
    def is_exact(self) -> bool:
        """Whether it is one value, which a short run on a busy machine has, too."""
        return self.at_most is None and self.at_least is None

    def holds(self, value: Any) -> bool:
        """Return whether *value* holds the bar."""
        if self.is_exact:
            return bool(value == self.equals)
        if value is None or math.isnan(value):
            return False
        return bool(value <= self.at_most if self.at_most is not None else value >= self.at_least)


def judge(bars: Sequence[Bar], figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return, for each bar, its figure (the worst one) and whether it is met; None if it was not measured."""
    judged = []
    for bar in bars:
        values = [value for value in _values(figures, bar.figure.split(".")) if value is not _MISSING]
        worst = next((value for value in values if not bar.holds(value)), values[0] if values else None)
        numbers = [value for value in values if isinstance(value, int | float) and not math.isnan(value)]
        if values and len(numbers) == len(values) and bar.equals is None:
            worst = max(numbers) if bar.at_most is not None else min(numbers)
        met = bar.holds(worst) if values else None
        judged.append({"figure": bar.figure, "limit": bar.limit, "value": worst, "met": met})
    return judged


_MISSING = object()


def _values(found: Any, keys: Sequence[str]) -> Iterator[Any]:
    if not keys:
        yield found
    elif keys[0] == "*":
        rows = found.values() if isinstance(found, Mapping) else found if isinstance(found, list) else ()
        for each in rows:
            yield from _values(each, keys[1:])
    elif isinstance(found, list) and keys[0].isdigit():
        yield from _values(found[int(keys[0])], keys[1:])
    elif isinstance(found, Mapping):
        yield from _values(found[keys[0]], keys[1:]) if keys[0] in found else (_MISSING,)


def say(text: object) -> None:
    """Show progress, beside the report."""
    print(text, file=sys.stderr, flush=True)


def show(report: Mapping[str, Any]) -> None:
    """Print the report as JSON, and a line for each bar beside it."""
    print(_text(report))
    for bar in report["bars"]:
        verdict = {True: "met", False: "MISSED", None: "not measured"}[bar["met"]]
        value = f"{bar['value']:.4g}" if isinstance(bar["value"], float) else bar["value"]
        say(f"{verdict:12} {bar['figure']} = {value} (bar {bar['limit']})")


def write(file: Path, report: Mapping[str, Any]) -> None:
    """Write the report as JSON."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(_text(report) + "\n", encoding="utf-8")


def _text(report: Mapping[str, Any]) -> str:
    return json.dumps(_plain(report), indent=1)


def _plain(value: Any) -> Any:
    """Return *value* as JSON knows it: NaN as null, keys as text, arrays as lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | set | np.ndarray):
        return [_plain(each) for each in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, str | int | float) else str(value)
