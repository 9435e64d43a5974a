"""Plan who computes a command, and when each of them is asked; `CommandRouter` carries the plan out.

The candidates are the backend servers, the burst function (AWS Lambda) and the robot itself.  The rule of the
paper (Sect. 6.2) is: "the saved time should be more than transmission delay so that real-time performance
gains from cloud computing".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rse_pf.service import Registry

__all__ = ["CloudFirst", "Plan"]

FALLBACK_MARGIN = 2.0
"""A fallback is asked while there is time for this many of its own expected answers, so that it is not
late."""

RECOVERABLE_CODES = frozenset(
    {
        "busy",
        "quota",
        "expired",
        "worker-lost",
        "poison",
        "internal",
        "disconnected",
        "connect",
        "unknown-service",
        "unauthorized",
        "forbidden",
        "conflict",
    }
)
"""Codes of failures that are no fault of the command itself, so that another place may succeed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Who computes one command, and from when on.

    Attributes:
        where: ``cloud`` asks the servers and never the robot, ``robot`` never the servers, ``both`` asks the
            servers at once and the robot later.
        robot_after_s: Seconds after which the robot itself is asked if there is no answer by then, or earlier
            if all others have failed; not used if *where* is ``cloud``.
        burst_after_s: Seconds after which the burst function is asked if there is no answer by then, or
            earlier if the servers have failed; None never asks it.
        why: The reason that is given in an answer of the burst function or of the robot.
    """

    where: Literal["cloud", "robot", "both"]
    robot_after_s: float = 0.0
    burst_after_s: float | None = None
    why: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudFirst:
    """Ask the servers first, then the burst function if there is one, and the robot itself at last.

    Each of them is asked early enough to meet the deadline.  The robot is the last because it needs no
    network.

    Attributes:
        registry: Services that the robot offers itself; None means the built-in ones.
        robot_solve_s: Expected time of the robot's own solver in seconds, until it was measured.
        slack_s: Time in seconds by which the robot starts earlier, because its processor has other work.
        take_faster: Whether the rule of the paper applies: do not ask a cloud that is slower than the robot.
    """

    registry: Registry | None = None
    robot_solve_s: float = 0.02
    slack_s: float = 0.02
    take_faster: bool = False

    def plan(
        self,
        *,
        deadline_s: float,
        connected: bool,
        expected_round_trip_s: float | None,
        robot_solve_s: float | None = None,
        robot_can: bool = True,
        burst_s: float | None = None,
    ) -> Plan:
        """Return the plan for one command.

        Args:
            deadline_s: Seconds from now within which the answer is needed.
            connected: Whether a server is connected.
            expected_round_trip_s: 95th percentile of recent round trips to a server, None if unknown.
            robot_solve_s: Recent time of the robot for such a command in seconds, None if unknown.
            robot_can: Whether the robot offers the service.
            burst_s: Expected time of an answer of the burst function, None if it cannot be asked.
        """
        # 1. Compute the latest moment at which the robot can start and still meet the deadline; leave out a
        #    burst function that needs more time than that.
        local_s = self.robot_solve_s if robot_solve_s is None else robot_solve_s
        robot_needs_s = FALLBACK_MARGIN * local_s if robot_can else 0.0
        latest_s = max(0.0, deadline_s - robot_needs_s - self.slack_s)
        if burst_s is not None and burst_s > latest_s:
            burst_s = None
        # 2. Without a server that can be in time, ask the burst function at once, and the robot as late as is
        #    safe; without a burst function, ask the robot at once.
        where: Literal["cloud", "both"] = "both" if robot_can else "cloud"
        is_slow = expected_round_trip_s is not None and expected_round_trip_s >= deadline_s
        if not connected or is_slow:
            why = "no connection to the cloud"
            if connected and expected_round_trip_s is not None:
                why = f"the cloud takes {expected_round_trip_s * 1e3:.0f} ms of {deadline_s * 1e3:.0f} ms"
            return Plan(
                where=where if connected or not robot_can else "robot",
                robot_after_s=0.0 if burst_s is None else latest_s,
                burst_after_s=None if burst_s is None else 0.0,
                why=why,
            )
        # 3. By the rule of the paper, ask the robot alone if it is not slower than the cloud.
        if self.take_faster and robot_can and expected_round_trip_s is not None:
            why = f"the robot takes {local_s * 1e3:.1f} ms, the cloud {expected_round_trip_s * 1e3:.1f} ms"
            if local_s <= expected_round_trip_s:
                return Plan(where="robot", why=why)
        # 4. Ask the servers now, and the others as late as is safe.
        burst_after_s = None
        if burst_s is not None:
            burst_after_s = _burst_after_s(latest_s, burst_s, expected_round_trip_s)
        return Plan(
            where=where,
            robot_after_s=latest_s,
            burst_after_s=burst_after_s,
            why="the cloud did not answer in time",
        )

    @staticmethod
    def can_recover(code: str) -> bool:
        """Return whether another place may succeed where one failed with the error *code*.

        An error of the command itself (too few points, no consensus) would occur everywhere.
        """
        return code in RECOVERABLE_CODES


def _burst_after_s(latest_s: float, burst_s: float, expected_round_trip_s: float | None) -> float:
    """Return after how many seconds the burst function is asked while a server has not answered yet.

    That is as late as is safe, and after the 95th percentile of the servers' round trips: a command that both
    answer is paid for twice.

    Source:
        Dean and Barroso 2013, "The tail at scale": a second request after the 95th percentile of the first.
    """
    return min(latest_s - burst_s, max(expected_round_trip_s or 0.0, latest_s - FALLBACK_MARGIN * burst_s))
