"""Statistics of benchmarks: percentiles, and the median ratio of pairs of runs."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from rse_pf.extensions.experiments.results.summary import percentiles

__all__ = ["median_ratio", "percentile", "spread"]


def percentile(values: Any, percent: Any, axis: int | None = None) -> Any:
    """Return the percentile of *values*, linear between two of them; NaN without any."""
    if not len(values):
        return np.full(np.shape(percent), np.nan)[()]
    return np.percentile(values, percent, axis=axis)


def spread(values: Iterable[float]) -> dict[str, float | int | None]:
    """Return n, mean, p50, p95, p99 and max, to three digits; None without any value."""
    return percentiles([float(value) for value in values])


def median_ratio(values: Sequence[float], bases: Sequence[float]) -> float:
    """Return the median of the ratios of the pairs of *values* and *bases*."""
    return statistics.median(value / base for value, base in zip(values, bases, strict=True))
