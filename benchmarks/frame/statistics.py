"""Statistics of benchmarks: percentiles, and the median ratio of pairs of runs."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from rse_pf.extensions.experiments.results.summary import percentiles

__all__ = ["median_ratio", "percentile", "spread"]


def percentile(values: Any, percent: Any, axis: int | None = None) -> Any:
    """Return a percentile of *values*, linearly interpolated between two of them; NaN without values."""
    if not len(values):
        return np.full(np.shape(percent), np.nan)[()]
    return np.percentile(values, percent, axis=axis)


def spread(values: Iterable[float]) -> dict[str, float | int | None]:
    """Return number, mean, p50, p95, p99 and maximum of values, with three decimals; None without values."""
    return percentiles([float(value) for value in values])


def median_ratio(values: Sequence[float], bases: Sequence[float]) -> float:
    """Return the median of the ratios of the pairs of *values* and *bases*."""
    return statistics.median(value / base for value, base in zip(values, bases, strict=True))
