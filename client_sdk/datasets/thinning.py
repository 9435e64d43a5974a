"""Choose the frames that play a recording or a camera at a lower rate, by their time stamps."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from itertools import pairwise

from rse_pf.errors import UsageError

__all__ = ["Thinning", "median_interval_s"]

_OWN_RATE = 1.05
"""Rates this close to the recording's own are its own: cameras of 30 Hz have 29.97 or 30.2."""
_RECENT = 31
_ROUNDING_S = 1e-6
"""Stamps are decimal fractions."""


class Thinning:
    """Decides for each frame, in order of time, whether it is played at *rate_hz*.

    Frames are due on a grid that begins at the first one; a frame serves a due time from half a frame
    interval before it.  Two frames are never closer than half of ``1 / rate_hz``.  A rate that is the frames'
    own, or higher, plays all of them, however close.
    """

    def __init__(self, rate_hz: float, *, interval_s: float | None = None) -> None:
        """Play at *rate_hz*; *interval_s* is the median one of the frames, None to learn it as they come.

        Raises:
            UsageError: The rate is not above 0.
        """
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise UsageError(f"rate {rate_hz:g} is not above 0", hint="name frames per second, such as 5")
        self._period_s = 1.0 / rate_hz
        self._interval_s = interval_s
        self._recent: deque[float] = deque(maxlen=_RECENT)
        self._start_s = self._due_s = self._played_s = -math.inf

    def plays(self, timestamp_s: float) -> bool:
        """Return whether the frame of *timestamp_s*, the next one, is played."""
        if self._interval_s is None:
            self._recent.append(timestamp_s)
        interval_s = median_interval_s(self._recent) if self._interval_s is None else self._interval_s
        is_own = self._period_s <= _OWN_RATE * interval_s + _ROUNDING_S
        early_s = min(interval_s, self._period_s) / 2.0 + _ROUNDING_S
        is_due = timestamp_s >= self._due_s - early_s
        is_apart = timestamp_s - self._played_s >= self._period_s / 2.0 - _ROUNDING_S
        if not (is_own or (is_due and is_apart)):
            return False
        if math.isinf(self._start_s):
            self._start_s = timestamp_s
        served = math.floor((timestamp_s - self._start_s + early_s) / self._period_s)
        self._due_s = self._start_s + (served + 1) * self._period_s
        self._played_s = timestamp_s
        return True


def median_interval_s(timestamps_s: Iterable[float]) -> float:
    """Return the median time between neighbours, the lower one of two; 0 for fewer than two frames."""
    intervals = sorted(later - earlier for earlier, later in pairwise(timestamps_s))
    return intervals[(len(intervals) - 1) // 2] if intervals else 0.0
