"""Which of several platforms a robot uses: the nearest by measurement, and when it changes.

A robot with several addresses keeps a connection to each: one carries its commands, the others stand by with
a ping now and then.  The rules are pure; they see round trips and losses, with the time of each.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

__all__ = ["MAX_REGIONS", "RegionChoice"]

MAX_REGIONS = 4
"""A connection to each is kept, and each costs its platform the place of a robot."""
_RECENT = 3
"""Round trips whose median counts: one late pong is no slow region."""
_RATIO, _GAIN_S = 0.75, 0.02
"""A region is clearly better with at most this share of the round trip, and at least this much less."""
_GAP_S = 10.0
"""Without a measurement for this long, the time begins anew: the robot may not have run."""
_MEMORY_S = 3600.0
_MAX_DOUBLINGS = 4


@dataclass(slots=True)
class _Region:
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT))
    losses: deque[float] = field(default_factory=deque)
    better_since: float | None = None
    compared: float = -math.inf


class RegionChoice:
    """The measurements of *count* regions, numbered from 0, and what follows from them.

    *hold_s*: seconds for which another region must be clearly better before the robot changes to it.  For a
    region that was lost several times within an hour it doubles with each loss.
    """

    def __init__(self, count: int, *, hold_s: float) -> None:
        self._regions = [_Region() for _ in range(count)]
        self._hold_s = hold_s

    def measured(self, region: int, round_trip_s: float) -> None:
        """Take the round trip of one ping into account."""
        self._regions[region].recent.append(round_trip_s)

    def lost(self, region: int, now: float) -> None:
        """Take into account that the connection to *region* was lost at *now*, seconds of any clock."""
        lost = self._regions[region]
        lost.losses.append(now)
        lost.recent.clear()
        lost.better_since = None

    def round_trip_s(self, region: int) -> float:
        """Return the median of the last round trips, infinite without one."""
        recent = self._regions[region].recent
        return statistics.median(recent) if recent else math.inf

    def best(self, among: Iterable[int]) -> int | None:
        """Return the region of *among* with the shortest round trip, the first of equal ones."""
        return min(among, key=lambda each: (self.round_trip_s(each), each), default=None)

    def better(self, current: int, among: Iterable[int], now: float) -> int | None:
        """Return the region of *among* that has been clearly better than *current* for long enough.

        Call it after each measurement.
        """
        long_enough = []
        for region in among:
            if region != current and self._has_been_better(region, current, now):
                long_enough.append(region)
        chosen = self.best(long_enough)
        if chosen is not None:
            self.changed()
        return chosen

    def changed(self) -> None:
        """Begin to compare anew: the robot uses another region."""
        for region in self._regions:
            region.better_since = None

    def _has_been_better(self, region: int, current: int, now: float) -> bool:
        other = self._regions[region]
        mine_s, other_s = self.round_trip_s(current), self.round_trip_s(region)
        if not (math.isfinite(mine_s) and other_s <= _RATIO * mine_s and mine_s - other_s >= _GAIN_S):
            other.better_since = None
            return False
        if other.better_since is None or now - other.compared > _GAP_S:
            other.better_since = now
        other.compared = now
        return now - other.better_since >= self._pause_needed_s(other, now)

    def _pause_needed_s(self, region: _Region, now: float) -> float:
        while region.losses and region.losses[0] <= now - _MEMORY_S:
            region.losses.popleft()
        return self._hold_s * 2.0 ** min(_MAX_DOUBLINGS, max(0, len(region.losses) - 1))
