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

__all__ = ["Bar", "check_bars", "say", "show", "write"]


@dataclass(frozen=True, slots=True)
class Bar:
    """A limit that a figure of a benchmark must keep: a largest number, a smallest number, or one value.

    *figure* is the path of the figure in the report, with dots between keys.  ``*`` stands for every key or
    row, of which the worst value counts.  A figure that is missing was not measured, and does not miss the
    bar; a figure of None or NaN does.
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
        """The limit of the bar as text, with its unit."""
        if self.at_most is not None:
            return f"<= {self.at_most:g} {self.unit}".strip()
        if self.at_least is not None:
            return f">= {self.at_least:g} {self.unit}".strip()
        return f"= {self.equals}"

    @property
    def is_exact(self) -> bool:
        """Whether the bar is one value, which does not depend on the duration of a run or the load."""
        return self.at_most is None and self.at_least is None

    def holds(self, value: Any) -> bool:
        """Return whether *value* keeps the limit of the bar."""
        if self.is_exact:
            return bool(value == self.equals)
        if value is None or math.isnan(value):
            return False
        return bool(value <= self.at_most if self.at_most is not None else value >= self.at_least)


def check_bars(bars: Sequence[Bar], figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return for each bar the worst value of its figure, and whether the bar is met (None: not measured)."""
    checked = []
    for bar in bars:
        values = [value for value in _values(figures, bar.figure.split(".")) if value is not _MISSING]
        worst = next((value for value in values if not bar.holds(value)), values[0] if values else None)
        numbers = [value for value in values if isinstance(value, int | float) and not math.isnan(value)]
        if values and len(numbers) == len(values) and bar.equals is None:
            worst = max(numbers) if bar.at_most is not None else min(numbers)
        met = bar.holds(worst) if values else None
        checked.append({"figure": bar.figure, "limit": bar.limit, "value": worst, "met": met})
    return checked


_MISSING = object()  # stands for a figure that a report does not have


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
    """Print a line of progress to standard error, so that standard output has the report alone."""
    print(text, file=sys.stderr, flush=True)


def show(report: Mapping[str, Any]) -> None:
    """Print the report as JSON to standard output, and a line for each bar to standard error."""
    print(_text(report))
    for bar in report["bars"]:
        verdict = {True: "met", False: "MISSED", None: "not measured"}[bar["met"]]
        value = f"{bar['value']:.4g}" if isinstance(bar["value"], float) else bar["value"]
        say(f"{verdict:12} {bar['figure']} = {value} (bar {bar['limit']})")


def write(file: Path, report: Mapping[str, Any]) -> None:
    """Write the report to *file* as JSON."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(_text(report) + "\n", encoding="utf-8")


def _text(report: Mapping[str, Any]) -> str:
    return json.dumps(_plain(report), indent=1)


def _plain(value: Any) -> Any:
    """Return *value* with the types of JSON: NaN becomes None, keys become text, arrays become lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | set | np.ndarray):
        return [_plain(each) for each in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if value is None or isinstance(value, str | int | float) else str(value)
