"""Count the processes that the bytes of a robot ended, and refuse a robot that ended two of them for a while.

Only what this robot sent counts, and only against it.  Its own deadline never counts: a command that was
given too little time says nothing about its bytes.  Time is an argument, and memory is bounded whatever
robots send.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

from rse_pf.errors import Busy
from rse_pf.identity import RobotId

__all__ = ["BLOCK_S", "MAX_CRASHES", "WINDOW_S", "CrashRecord"]

WINDOW_S = 300.0
"""Crashes of a robot that lie further apart do not count together."""
MAX_CRASHES = 2
"""Number of crashes after which the robot that caused them is refused."""
BLOCK_S = 60.0
"""For this long after the last of them."""
_MAX_ROBOTS = 10_000
"""Robots whose crashes are remembered; the one whose last crash is oldest is forgotten first."""


class CrashRecord:
    """The crashes that the robots of one server or worker caused; may be used by several threads.

    A supervisor uses `note_crash` and `blocked` for its workers, a worker `refusal` for limited services.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._crashes_s: OrderedDict[RobotId, tuple[float, ...]] = OrderedDict()

    def refusal(self, robot: RobotId, now: float) -> Busy | None:
        """Return why *robot* may not use limited services now, None if it may."""
        with self._lock:
            rest_s = _rest_s(self._crashes_s.get(robot, ()), now)
        if rest_s <= 0:
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
            crashes = self._crashes_s.pop(robot, ())
            is_first = not crashes or len(crashes) == MAX_CRASHES or now - crashes[0] > WINDOW_S
            if _rest_s(crashes, now) <= 0:  # else it was sent before the robot was refused
                crashes = (now,) if is_first else (*crashes, now)
            self._crashes_s[robot] = crashes
            if len(self._crashes_s) > _MAX_ROBOTS:
                self._crashes_s.popitem(last=False)
            return len(crashes) == MAX_CRASHES and crashes[-1] == now

    def blocked(self, now: float) -> list[tuple[RobotId, float]]:
        """Return the robots that are refused at *now*, each with the seconds that are left."""
        with self._lock:
            rests_s = [(robot, _rest_s(crashes_s, now)) for robot, crashes_s in self._crashes_s.items()]
        return [(robot, rest_s) for robot, rest_s in rests_s if rest_s > 0]


def _rest_s(crashes_s: tuple[float, ...], now: float) -> float:
    """Return for how long a robot with these crashes is still refused."""
    return crashes_s[-1] + BLOCK_S - now if len(crashes_s) == MAX_CRASHES else 0.0
