"""Pair the time stamps of two sensors by nearest time."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["nearest_gap_s", "pair_stamps"]

Stamps = npt.NDArray[np.int64]
_Times = npt.NDArray[Any]  # all of one unit, integers or floats


def pair_stamps(first: _Times, second: _Times, within: float) -> list[tuple[int, int]]:
    """Return ``(row of first, row of second)`` of the times that are nearest to each other.

    Args:
        first: Times, ascending.
        second: Times in the same unit, ascending.
        within: Largest difference of a pair; each row is in at most one pair.
    """
    if not len(first) or not len(second):
        return []
    nearest = _nearest(first, second)
    apart = np.abs(second[nearest] - first)
    best: dict[int, tuple[float, int]] = {}
    for row in np.flatnonzero(apart <= within):
        partner = int(nearest[row])
        if partner not in best or apart[row] < best[partner][0]:
            best[partner] = (apart[row], int(row))
    return sorted((row, partner) for partner, (_, row) in best.items())


def nearest_gap_s(first: Stamps, second: Stamps) -> float:
    """Return the smallest time between a stamp of one and a stamp of the other, seconds."""
    return float(np.abs(second[_nearest(first, second)] - first).min()) / 1e9


def _nearest(first: _Times, second: _Times) -> Stamps:
    """Return for each of *first* the row of the nearest of *second*."""
    after = np.minimum(np.searchsorted(second, first), len(second) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(first - second[before]) <= np.abs(second[after] - first), before, after)
