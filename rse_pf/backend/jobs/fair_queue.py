"""Decide whose job runs next and whose is displaced: robots take turns, however many jobs they ask for.

Pure.  A robot that asks for one job waits for at most one job of each robot that asked before it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rse_pf.identity import RobotId

__all__ = ["FairQueue", "job_to_displace"]


class FairQueue:
    """Waiting tickets: robots take turns, and each robot's tickets keep their order."""

    def __init__(self) -> None:
        self._tickets: dict[RobotId, list[object]] = {}

    def add(self, ticket: object, robot: RobotId) -> None:
        """Add *ticket* of *robot*; a robot that had none takes the last turn."""
        self._tickets.setdefault(robot, []).append(ticket)

    def first(self) -> object | None:
        """Return the ticket whose turn it is, None if there is none."""
        return next(iter(self._tickets.values()))[0] if self._tickets else None

    def serve(self, ticket: object) -> None:
        """Remove *ticket* because it was served: its robot goes behind all others."""
        robot = self.remove(ticket)
        if robot in self._tickets:
            self._tickets[robot] = self._tickets.pop(robot)

    def remove(self, ticket: object) -> RobotId | None:
        """Remove *ticket*, if it waits, and return its robot, which keeps its turn."""
        for robot, tickets in self._tickets.items():
            if ticket in tickets:
                tickets.remove(ticket)
                if not tickets:
                    del self._tickets[robot]
                return robot
        return None


def job_to_displace(jobs: Sequence[tuple[RobotId, bool]], newcomer: RobotId) -> int | None:
    """Return which of *jobs* is displaced by one more of *newcomer*; None if the newcomer is refused.

    It is the newest waiting job of the robot with the most jobs, if that robot has at least two more than
    the newcomer: with one, the two would only change places.

    Args:
        jobs: Each job's robot and whether it still waits, oldest first.
        newcomer: Robot of the new job.
    """
    count = Counter(robot for robot, _ in jobs)
    rows = [row for row, (robot, waits) in enumerate(jobs) if waits and count[robot] > count[newcomer] + 1]
    return max(rows, key=lambda row: (count[jobs[row][0]], row), default=None)
