"""Count the invalid requests of each robot, and say for how long one that sent too many is cut off.

Times and robots go in, seconds come out; the memory is bounded whatever robots send.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rse_pf.identity import RobotId

__all__ = ["GarbageCounts"]

_MAX_IN_WINDOW, _WINDOW_S = 10, 60.0
"""A robot whose SDK fits sends none."""
_CUT_OFF_S = 60.0
_MAX_ROBOTS = 4096


@dataclass(slots=True)
class _Count:
    since_s: float
    count: int = 0
    cut_off_until_s: float = -math.inf


class GarbageCounts:
    """The invalid requests of one worker's robots."""

    def __init__(self) -> None:
        """Know no robot yet."""
        self._counts: dict[RobotId, _Count] = {}

    def __len__(self) -> int:
        """Return how many robots are remembered."""
        return len(self._counts)

    def note(self, robot: RobotId, now: float) -> None:
        """Count one invalid request of *robot* at *now* (s, monotonic)."""
        known = self._counts.pop(robot, None)
        if known is None or now - known.since_s > _WINDOW_S:
            known = _Count(now)
        self._counts[robot] = known
        known.count += 1
        if known.count >= _MAX_IN_WINDOW:
            known.cut_off_until_s = now + _CUT_OFF_S
        if len(self._counts) > _MAX_ROBOTS:
            del self._counts[next(iter(self._counts))]

    def cut_off_s(self, robot: RobotId, now: float) -> float:
        """Return for how many seconds more the requests of *robot* are refused; 0 if they are not."""
        known = self._counts.get(robot)
        return 0.0 if known is None else max(0.0, known.cut_off_until_s - now)
