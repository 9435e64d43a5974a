"""Count the processes that the commands of each robot crashed, and refuse a robot for a while after two.

A crash counts against the robot whose command caused it, and against no other robot.  A command that was
killed at its own deadline does not count: a short deadline is no evidence of harmful bytes.  The caller
passes the time (``now``: monotonic seconds); the number of robots that are remembered is bounded.
"""

from __future__ import annotations

import threading
from collections import OrderedDict

from rse_pf.errors import Busy
from rse_pf.identity import RobotId

__all__ = ["BLOCK_S", "MAX_CRASHES", "WINDOW_S", "CrashRecord"]

WINDOW_S = 300.0
"""Longest time in seconds between the first and the second crash of a robot: after a longer time, the later
crash counts as the first one."""
MAX_CRASHES = 2
"""Number of crashes after which a robot is refused; a single crash may be an accident."""
BLOCK_S = 60.0
"""Seconds for which a robot is refused after its second crash (`MAX_CRASHES`).  Afterwards its crashes are
counted from 0 again, so that it crashes at most two processes a minute."""
_MAX_ROBOTS = 10_000
"""Most robots whose crashes are remembered; above that, the robot whose last crash is oldest is forgotten."""


class CrashRecord:
    """The crashes that the robots of one server or worker caused; several threads may call its methods.

    A supervisor calls `note_crash` and `blocked`; a worker calls `refusal` before it runs a limited service.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._crashes_s: OrderedDict[RobotId, tuple[float, ...]] = OrderedDict()

    def refusal(self, robot: RobotId, now: float) -> Busy | None:
        """Return the error with which limited services refuse *robot* now, None if they accept it."""
        with self._lock:
            rest_s = _rest_s(self._crashes_s.get(robot, ()), now)
        if rest_s <= 0:
            return None
        return Busy(
            f"commands of this robot crashed {MAX_CRASHES} processes; "
            f"map services refuse it for another {rest_s:.0f} s",
            hint="send smaller maps; the server's log names the crashes",
            retry_after_ms=rest_s * 1e3,
        )

    def note_crash(self, robot: RobotId, now: float) -> bool:
        """Count a crash that a command of *robot* caused at *now*.

        Returns whether the robot is refused because of this crash.  A crash of a robot that is refused
        already is not counted.
        """
        with self._lock:
            crashes = self._crashes_s.pop(robot, ())
            is_first = not crashes or len(crashes) == MAX_CRASHES or now - crashes[0] > WINDOW_S
            if _rest_s(crashes, now) <= 0:  # otherwise the command came before the robot was refused
                crashes = (now,) if is_first else (*crashes, now)
            self._crashes_s[robot] = crashes
            if len(self._crashes_s) > _MAX_ROBOTS:
                self._crashes_s.popitem(last=False)
            return len(crashes) == MAX_CRASHES and crashes[-1] == now

    def blocked(self, now: float) -> list[tuple[RobotId, float]]:
        """Return the robots that are refused at *now*, each with the seconds until it is accepted again."""
        with self._lock:
            rests_s = [(robot, _rest_s(crashes_s, now)) for robot, crashes_s in self._crashes_s.items()]
        return [(robot, rest_s) for robot, rest_s in rests_s if rest_s > 0]


def _rest_s(crashes_s: tuple[float, ...], now: float) -> float:
    """Return the seconds for which a robot with crashes at these times is still refused; at most 0 if not."""
    return crashes_s[-1] + BLOCK_S - now if len(crashes_s) == MAX_CRASHES else 0.0
