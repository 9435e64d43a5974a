"""Choose the region (platform) that a robot uses: the one with the shortest measured round trip.

A robot with several addresses keeps a connection to each: one carries its commands, the others stand by and
are pinged.  These rules are pure: they receive round trips and losses, with the time of each.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

__all__ = ["MAX_REGIONS", "RegionChoice"]

MAX_REGIONS = 4
"""Most addresses of one robot; a connection to each is kept, and counts as one robot in the limits of its
platform."""
MEDIAN_SIZE = 3
"""The round trip of a region is the median of this many pings, so that one late pong does not count."""
MAX_ROUND_TRIP_RATIO = 0.75
"""A region is clearly nearer only if its round trip is at most this share of the present one."""
MIN_ROUND_TRIP_GAIN_S = 0.02
"""A region is clearly nearer only if its round trip is shorter by at least this time in seconds: a smaller
gain is not worth a change, however large its share."""
MAX_MEASUREMENT_GAP_S = 10.0
"""If a region was not compared for this many seconds, the time for which it has been nearer is counted from 0
again: the robot may have been suspended."""
LOSS_MEMORY_S = 3600.0
"""For this many seconds a lost connection to a region counts for `MAX_HOLD_DOUBLINGS`, so that a robot
returns later to a region that loses connections."""
MAX_HOLD_DOUBLINGS = 4
"""The time for which a region must be nearer before the robot changes to it doubles with each connection to
the region that was lost in the last hour, except the first one, at most this often: it becomes at most 16
times as long."""


@dataclass(slots=True)
class _RegionHistory:
    round_trips_s: deque[float] = field(default_factory=lambda: deque(maxlen=MEDIAN_SIZE))
    losses_s: deque[float] = field(default_factory=deque)
    nearer_since_s: float | None = None
    compared_s: float = -math.inf


class RegionChoice:
    """Measure the regions of one robot, numbered from 0, and say when to change to another one."""

    def __init__(self, count: int, *, hold_s: float) -> None:
        """Begin without measured round trips.

        Args:
            count: Number of regions.
            hold_s: How many seconds another region must be clearly nearer before the robot changes to it.
                It doubles with each connection to that region that was lost in the last hour, except the
                first one, and becomes at most 16 times as long.
        """
        self._regions = [_RegionHistory() for _ in range(count)]
        self._hold_s = hold_s

    def add_round_trip(self, region: int, round_trip_s: float) -> None:
        """Record the round trip of one ping to *region*."""
        self._regions[region].round_trips_s.append(round_trip_s)

    def add_loss(self, region: int, now_s: float) -> None:
        """Record that the connection to *region* was lost at *now_s*, by the clock of `find_nearer_region`.

        The region then counts as infinitely far until its next ping.
        """
        history = self._regions[region]
        history.losses_s.append(now_s)
        history.round_trips_s.clear()
        history.nearer_since_s = None

    def round_trip_s(self, region: int) -> float:
        """Return the median of the last three round trips to *region*, infinite without one."""
        round_trips_s = self._regions[region].round_trips_s
        return statistics.median(round_trips_s) if round_trips_s else math.inf

    def nearest(self, regions: Iterable[int]) -> int | None:
        """Return the one of *regions* with the shortest round trip; None if *regions* is empty.

        Of equal ones, also of regions without a measured round trip, it is the one with the lowest number.
        """
        return min(regions, key=lambda region: (self.round_trip_s(region), region), default=None)

    def find_nearer_region(self, current: int, regions: Iterable[int], now_s: float) -> int | None:
        """Return the one of *regions* to change to: clearly nearer than *current* for long enough; or None.

        Call this after each measurement; *now_s* is in seconds of a monotonic clock.  If a region is
        returned, `restart_comparison` is called for all regions.
        """
        candidates = []
        for region in regions:
            if region != current and self._has_been_nearer(region, current, now_s):
                candidates.append(region)
        chosen = self.nearest(candidates)
        if chosen is not None:
            self.restart_comparison()
        return chosen

    def restart_comparison(self) -> None:
        """Forget for how long regions have been nearer, because the robot uses another region now."""
        for history in self._regions:
            history.nearer_since_s = None

    def _has_been_nearer(self, region: int, current: int, now_s: float) -> bool:
        history = self._regions[region]
        current_s, candidate_s = self.round_trip_s(current), self.round_trip_s(region)
        is_nearer = (
            math.isfinite(current_s)
            and candidate_s <= MAX_ROUND_TRIP_RATIO * current_s
            and current_s - candidate_s >= MIN_ROUND_TRIP_GAIN_S
        )
        if not is_nearer:
            history.nearer_since_s = None
            return False
        if history.nearer_since_s is None or now_s - history.compared_s > MAX_MEASUREMENT_GAP_S:
            history.nearer_since_s = now_s
        history.compared_s = now_s
        return now_s - history.nearer_since_s >= self._required_s(history, now_s)

    def _required_s(self, history: _RegionHistory, now_s: float) -> float:
        """Return for how many seconds a region with this history must be nearer."""
        while history.losses_s and history.losses_s[0] <= now_s - LOSS_MEMORY_S:
            history.losses_s.popleft()
        return self._hold_s * 2.0 ** min(MAX_HOLD_DOUBLINGS, max(0, len(history.losses_s) - 1))
