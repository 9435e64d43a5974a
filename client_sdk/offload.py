"""Where a command is solved: in the cloud, on the robot, or on both.

The paper's rule (Sect. 6.2): offload only if the time saved is more than the transmission delay, and
assign work to the cloud that is not sensitive to delay.  Promises to decide only: no clock, no
socket, no solver.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rse_pf.service import Registry

__all__ = ["CloudFirst", "Plan"]

_MARGIN = 1.25
"""A fallback begins this much earlier than the robot's own solver needs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What to do with one command.

    ``robot_after_s`` is when the robot starts to solve it itself, in seconds from now, if the cloud
    has not answered; None means never.
    """

    where: Literal["cloud", "robot"]
    robot_after_s: float | None
    why: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudFirst:
    """Ask the cloud; answer on the robot when the cloud cannot make the deadline, and say so.

    Attributes:
        registry: The services that the robot has itself; None means the platform's own.
        robot_solve_s: How long the robot's own solver takes; measured as it is used.
    """

    registry: Registry | None = None
    robot_solve_s: float = 0.02

    def plan(
        self,
        *,
        deadline_s: float,
        connected: bool,
        expected_round_trip_s: float | None,
        robot_solve_s: float | None = None,
    ) -> Plan:
        """Return the plan for a command that must be answered within *deadline_s*.

        Args:
            deadline_s: Seconds from now.
            connected: Whether a link is open.
            expected_round_trip_s: The 95th percentile of recent round trips, or None if unknown.
            robot_solve_s: The robot's own recent time for such a command, or None if unknown.
        """
        mine_s = _MARGIN * (self.robot_solve_s if robot_solve_s is None else robot_solve_s)
        latest_s = max(0.0, deadline_s - mine_s)
        if not connected:
            return Plan(where="robot", robot_after_s=0.0, why="no connection to the cloud")
        if expected_round_trip_s is not None and expected_round_trip_s > deadline_s:
            return Plan(
                where="cloud",
                robot_after_s=0.0,
                why=f"the cloud takes {expected_round_trip_s * 1e3:.0f} ms, more than the deadline",
            )
        return Plan(where="cloud", robot_after_s=latest_s, why="the cloud did not answer in time")
