"""Keep a robot whose bytes ended processes from what would start more of them, for a while.

Only what this robot sent counts, and only against it.  Its own deadline never counts: a command that was
given too little time says nothing about its bytes.  Time is an argument, and memory is bounded whatever
robots send.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque

from rse_pf.errors import Busy
from rse_pf.identity import RobotId

__all__ = ["BLOCK_S", "MAX_CRASHES", "WINDOW_S", "CrashRecord"]

WINDOW_S = 300.0
"""`MAX_CRASHES` within this keep the robot out for `BLOCK_S`."""
MAX_CRASHES = 2
BLOCK_S = 60.0
_MAX_ROBOTS = 10_000


class CrashRecord:
    """Which robots ended processes of one worker or data server, and when; may be used by several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._crashes: OrderedDict[RobotId, deque[float]] = OrderedDict()
        self._blocked_until: dict[RobotId, float] = {}

    def refusal(self, robot: RobotId, now: float) -> Busy | None:
        """Return why *robot* may not use limited services now, None if it may."""
        with self._lock:
            rest_s = self._blocked_until.get(robot, now) - now
            if rest_s <= 0:
                self._blocked_until.pop(robot, None)
                return None
        return Busy(
            f"commands of this robot ended {MAX_CRASHES} processes; "
            f"map services are refused to it for another {rest_s:.0f} s",
            hint="send smaller maps; the server's log names the crashes",
            retry_after_ms=rest_s * 1e3,
        )

    def note_crash(self, robot: RobotId, now: float) -> bool:
        """Note that a command of *robot* ended a process; return whether the robot is blocked from now on."""
        with self._lock:
            crashes = self._crashes.pop(robot, None) or deque(maxlen=MAX_CRASHES)
            crashes.append(now)
            if len(crashes) == MAX_CRASHES and now - crashes[0] <= WINDOW_S:
                self._blocked_until[robot] = now + BLOCK_S
                if len(self._blocked_until) > _MAX_ROBOTS:
                    del self._blocked_until[next(iter(self._blocked_until))]
                return True
            self._crashes[robot] = crashes
            if len(self._crashes) > _MAX_ROBOTS:
                self._crashes.popitem(last=False)
            return False

    def count_blocked(self, now: float) -> int:
        """Return how many robots are refused now."""
        with self._lock:
            return sum(until_s > now for until_s in self._blocked_until.values())
