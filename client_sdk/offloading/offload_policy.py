"""Where a command is solved: by a server, by the burst function, or on the robot, and from when on.

The paper's rule (Sect. 6.2): "the saved time should be more than transmission delay so that real-time
performance gains from cloud computing".  This module only decides;
`client_sdk.offloading.command_router` carries the plan out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rse_pf.service import Registry

__all__ = ["CloudFirst", "Plan"]

# A fallback begins this many of its own expected times before the last moment at which it helps.
_MARGIN = 2.0

_RECOVERABLE = frozenset(
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Where to solve one command.

    ``cloud`` asks the servers alone and ``robot`` the robot alone; ``both`` asks the servers, and
    after ``robot_after_s`` seconds the robot too, unless there is an answer by then.  The burst function is
    asked after ``burst_after_s`` seconds, or as soon as the servers have failed; None asks it never.
    ``why`` is the reason given in an answer that is not a server's.
    """

    where: Literal["cloud", "robot", "both"]
    robot_after_s: float = 0.0
    burst_after_s: float | None = None
    why: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudFirst:
    """Ask the servers, then the burst function if there is one, and at last the robot itself.

    Each is asked while it can still meet the deadline; the robot itself needs no network, so it is the last.

    Attributes:
        registry: The services that the robot offers itself; None means the built-in ones.
        robot_solve_s: How long the robot's own solver takes, until it is measured.
        slack_s: Further time by which a fallback starts earlier, because the processor is shared.
        take_faster: Apply the paper's rule: do not ask a cloud that is slower than the robot.
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
        """Return the plan for a command that must be answered within *deadline_s*.

        Args:
            deadline_s: Seconds from now.
            connected: Whether a connection is open.
            expected_round_trip_s: The 95th percentile of recent round trips, or None if unknown.
            robot_solve_s: The robot's own recent time for such a command, or None if unknown.
            robot_can: Whether the robot offers the service.
            burst_s: Expected time of an answer of the burst function, or None if it cannot be asked.
        """
        local_s = self.robot_solve_s if robot_solve_s is None else robot_solve_s
        latest_s = max(0.0, deadline_s - (_MARGIN * local_s if robot_can else 0.0) - self.slack_s)
        if burst_s is not None and burst_s > latest_s:
            burst_s = None
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
        if self.take_faster and robot_can and expected_round_trip_s is not None:
            why = f"the robot takes {local_s * 1e3:.1f} ms, the cloud {expected_round_trip_s * 1e3:.1f} ms"
            if local_s <= expected_round_trip_s:
                return Plan(where="robot", why=why)
        return Plan(
            where=where,
            robot_after_s=latest_s,
            burst_after_s=None
            if burst_s is None
            else _last_chance_s(latest_s, burst_s, expected_round_trip_s),
            why="the cloud did not answer in time",
        )

    @staticmethod
    def can_recover(code: str) -> bool:
        """Whether the robot may succeed where the cloud failed with *code*.

        An error of the command itself (too few points, no consensus) would occur on the robot as well.
        """
        return code in _RECOVERABLE


def _last_chance_s(latest_s: float, burst_s: float, expected_round_trip_s: float | None) -> float:
    """Return when the burst function is asked beside a server that has not answered yet.

    As late as it is safe, and not while most answers of the servers are still on their way: each command
    that both answer is paid for nothing.

    Source:
        Dean and Barroso 2013, "The tail at scale": a second request after the 95th percentile of the first.
    """
    return min(latest_s - burst_s, max(expected_round_trip_s or 0.0, latest_s - _MARGIN * burst_s))
