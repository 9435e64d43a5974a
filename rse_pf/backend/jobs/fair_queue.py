"""Decide whose job runs next and whose is displaced: tenants take turns, and the robots of each tenant do.

Pure.  A tenant that asks for one job waits for at most one job of each tenant that asked before it, however
many robots these have; a robot waits for at most one job of each robot of its tenant.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rse_pf.identity import RobotId

__all__ = ["FairQueue", "job_to_displace"]


class FairQueue:
    """Waiting tickets: tenants and their robots take turns, and each robot's tickets keep their order."""

    def __init__(self) -> None:
        self._tenants: dict[str, dict[RobotId, list[object]]] = {}

    def add(self, ticket: object, robot: RobotId) -> None:
        """Add *ticket* of *robot*; a robot that had none takes the last turn of its tenant."""
        self._tenants.setdefault(robot.tenant, {}).setdefault(robot, []).append(ticket)

    def first(self) -> object | None:
        """Return the ticket whose turn it is, None if there is none."""
        for robots in self._tenants.values():
            return next(iter(robots.values()))[0]
        return None

    def serve(self, ticket: object) -> None:
        """Remove *ticket* because it was served: its tenant goes behind all others, its robot there, too."""
        robot = self.remove(ticket)
        robots = None if robot is None else self._tenants.pop(robot.tenant, None)
        if robot is not None and robots is not None:
            self._tenants[robot.tenant] = robots
            if robot in robots:
                robots[robot] = robots.pop(robot)

    def remove(self, ticket: object) -> RobotId | None:
        """Remove *ticket*, if it waits, and return its robot, which keeps its turn."""
        for tenant, robots in self._tenants.items():
            for robot, tickets in robots.items():
                if ticket in tickets:
                    tickets.remove(ticket)
                    if not tickets:
                        del robots[robot]
                    if not robots:
                        del self._tenants[tenant]
                    return robot
        return None


def job_to_displace(jobs: Sequence[tuple[RobotId, bool]], newcomer: RobotId) -> int | None:
    """Return which of *jobs* is displaced by one more of *newcomer*; None if the newcomer is refused.

    It is the newest waiting job of the tenant with the most jobs, and there of the robot with the most: of
    another tenant that has at least two more than the newcomer's, or of another robot of the same tenant that
    has at least two more than the newcomer.  With one, the two would only change places.

    Args:
        jobs: Each job's robot and whether it still waits, oldest first.
        newcomer: Robot of the new job.
    """
    of_robot = Counter(robot for robot, _ in jobs)
    of_tenant = Counter(robot.tenant for robot, _ in jobs)

    def gives(robot: RobotId) -> bool:
        if robot.tenant == newcomer.tenant:
            return of_robot[robot] > of_robot[newcomer] + 1
        return of_tenant[robot.tenant] > of_tenant[newcomer.tenant] + 1

    def rank(row: int) -> tuple[int, int, int]:
        robot = jobs[row][0]
        return of_tenant[robot.tenant], of_robot[robot], row

    rows = [row for row, (robot, waits) in enumerate(jobs) if waits and gives(robot)]
    return max(rows, key=rank, default=None)
