"""Plan where a command is computed, and when each place is asked; `CommandRouter` carries the plan out.

The places are the backend servers, the burst function (AWS Lambda) and the robot itself.  The rule of the
paper that this platform implements (Sect. 6.2) is: "the saved time should be more than transmission delay so
that real-time performance gains from cloud computing".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rse_pf.service import Registry

__all__ = ["CloudFirst", "Plan"]

FALLBACK_MARGIN = 2.0
"""A fallback is asked this many times its expected answer time before its answer is needed, so that an answer
that is slower than expected is still in time.  If the servers are slow, the burst function is asked later
than that (`_burst_after_s`)."""

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
"""Error codes of failures after which another place may succeed with the same command, because its arguments
are not the cause; `rse_pf.errors` explains each code."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Where one command is computed, and when each place is asked.

    Attributes:
        where: ``cloud`` asks the backend servers and never the robot itself; ``robot`` asks the robot and
            never the servers; ``both`` asks the servers at once, and the robot after *robot_after_s*.  The
            burst function does not depend on *where*, only on *burst_after_s*.
        robot_after_s: Seconds from the call after which the robot itself is asked if there is no answer yet;
            it is asked earlier if the other places have failed.  Not used if *where* is ``cloud``.
        burst_after_s: Seconds from the call after which the burst function is asked if there is no answer
            yet; it is asked earlier if the servers have failed.  None means that it is never asked.
        why: The field ``why`` of an answer of the burst function or the robot: why no server answered.
    """

    where: Literal["cloud", "robot", "both"]
    robot_after_s: float = 0.0
    burst_after_s: float | None = None
    why: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudFirst:
    """Ask the servers first, then the burst function if there is one, and the robot itself last.

    A place that has not answered stays asked while the next one works, and the first answer counts.  Each
    place is asked early enough to meet the deadline.  The robot is the last because it needs no network.

    Attributes:
        registry: Services that the robot computes itself; None means the built-in ones.
        robot_solve_s: Expected time in seconds of an answer of the robot itself, until it is measured.
        slack_s: Time in seconds by which the robot starts earlier, because its processor has other work.
        take_faster: Whether to apply the rule of the paper, too: if the expected time of the robot is at most
            the expected round trip to a server, ask the robot alone.  Without it, the servers are asked first
            even if they are slower.
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
            connected: Whether the robot is connected to a server.
            expected_round_trip_s: 95th percentile of recent round trips to a server in seconds; None if
                unknown.
            robot_solve_s: Expected time in seconds of an answer of the robot itself by its recent answers;
                None if it has not answered yet, so that the attribute *robot_solve_s* counts.
            robot_can: Whether the robot can compute the service.
            burst_s: Expected time in seconds of an answer of the burst function; None if it cannot be asked.
        """
        # 1. Compute the latest time at which the robot starts: the deadline less twice the solving time of
        #    the robot (0 if it cannot compute the service) and less `slack_s`.  Leave out the burst function
        #    if it would probably answer after this time.
        local_s = self.robot_solve_s if robot_solve_s is None else robot_solve_s
        robot_needs_s = FALLBACK_MARGIN * local_s if robot_can else 0.0
        latest_s = max(0.0, deadline_s - robot_needs_s - self.slack_s)
        if burst_s is not None and burst_s > latest_s:
            burst_s = None
        # 2. If no server can be in time, ask the burst function at once, and the robot at its latest time;
        #    without a burst function, ask the robot at once.
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
        # 3. By the rule of the paper, ask the robot alone if it is not slower than a server.
        if self.take_faster and robot_can and expected_round_trip_s is not None:
            why = f"the robot takes {local_s * 1e3:.1f} ms, the cloud {expected_round_trip_s * 1e3:.1f} ms"
            if local_s <= expected_round_trip_s:
                return Plan(where="robot", why=why)
        # 4. Ask the servers at once, and the other places at their latest times.
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
        """Return whether another place may succeed after one has failed with the error *code*.

        A failure that the arguments of the command cause (too few points, no consensus) would occur
        everywhere.
        """
        return code in RECOVERABLE_CODES


def _burst_after_s(latest_s: float, burst_s: float, expected_round_trip_s: float | None) -> float:
    """Return how many seconds after the servers the burst function is asked if none has answered yet.

    A command that both compute is paid for twice, so the function is asked late: twice its expected time
    *burst_s* before *latest_s*, at which the robot starts.  If the 95th percentile of the servers' round
    trips is later, it waits for that, too, but no longer than until *burst_s* before *latest_s*.

    Source:
        Dean and Barroso 2013, "The tail at scale": a second request after the 95th percentile of the first.
    """
    return min(latest_s - burst_s, max(expected_round_trip_s or 0.0, latest_s - FALLBACK_MARGIN * burst_s))
