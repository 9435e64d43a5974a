"""Lower the frame rate of a recording or a camera: select frames by their time stamps."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from itertools import pairwise

from rse_pf.errors import UsageError

__all__ = ["Thinning", "median_interval_s"]

_SAME_RATE_RATIO = 1.05
"""All frames are selected if the wanted period is at most this many times the frame interval: cameras of 30
Hz have 29.97 or 30.2 Hz, and must not lose frames when 30 Hz are wanted."""
_INTERVAL_WINDOW = 31
"""The frame interval of a live camera is the median interval of this many latest time stamps."""
_ROUNDING_S = 1e-6  # tolerance, in seconds, of comparisons of times, which are rounded decimal fractions


class Thinning:
    """Select frames, one after the other in the order of time, so that *rate_hz* frames per second remain.

    The wanted period is ``1 / rate_hz``; the frame interval is the median time between two given frames.
    Frames are due at multiples of the wanted period after the first frame.  For each due time, the first
    frame that is at most half a frame interval early is selected; two selected frames are at least half a
    wanted period apart.  All frames are selected if the wanted rate is that of the frames, or higher.
    """

    def __init__(self, rate_hz: float, *, interval_s: float | None = None) -> None:
        """Store the rate; no frame was given yet.

        Args:
            rate_hz: Wanted frames per second.
            interval_s: Frame interval, s; None estimates it from the latest 31 frames.

        Raises:
            UsageError: The rate is not above 0.
        """
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            raise UsageError(
                f"rate {rate_hz:g} is not a finite number above 0", hint="name frames per second, such as 5"
            )
        self._period_s = 1.0 / rate_hz
        self._interval_s = interval_s
        self._recent: deque[float] = deque(maxlen=_INTERVAL_WINDOW)
        self._start_s = self._due_s = self._selected_s = -math.inf

    def selects(self, timestamp_s: float) -> bool:
        """Return whether the next frame, whose time stamp is *timestamp_s*, is selected.

        Call it once for each frame, in the order of time: the answer depends on the frames before.
        """
        if self._interval_s is None:
            self._recent.append(timestamp_s)
        interval_s = median_interval_s(self._recent) if self._interval_s is None else self._interval_s
        is_same_rate = self._period_s <= _SAME_RATE_RATIO * interval_s + _ROUNDING_S
        early_s = min(interval_s, self._period_s) / 2.0 + _ROUNDING_S
        is_due = timestamp_s >= self._due_s - early_s
        is_apart = timestamp_s - self._selected_s >= self._period_s / 2.0 - _ROUNDING_S
        if not (is_same_rate or (is_due and is_apart)):
            return False
        if math.isinf(self._start_s):
            self._start_s = timestamp_s
        due_count = math.floor((timestamp_s - self._start_s + early_s) / self._period_s)
        self._due_s = self._start_s + (due_count + 1) * self._period_s
        self._selected_s = timestamp_s
        return True


def median_interval_s(timestamps_s: Iterable[float]) -> float:
    """Return the median time between successive frames, s; 0 for fewer than two frames.

    The median of an even number of intervals is the shorter of the two in the middle.
    """
    intervals = sorted(later - earlier for earlier, later in pairwise(timestamps_s))
    return intervals[(len(intervals) - 1) // 2] if intervals else 0.0
