"""The order in which robots that wait get their turns: tenants in turn, and the robots of each in turn.

So a tenant with many robots takes no more of a server's compute than one with a single robot that waits.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, field

from rse_pf.identity import RobotId

__all__ = ["Turns"]


@dataclass
class Turns:
    """Robots that wait, each of them once."""

    _tenants: OrderedDict[str, deque[RobotId]] = field(default_factory=OrderedDict)
    _count: int = 0

    def __len__(self) -> int:
        """Return how many robots wait."""
        return self._count

    @property
    def first(self) -> RobotId:
        """The robot whose turn is next; raises StopIteration if none waits."""
        return next(iter(self._tenants.values()))[0]

    def append(self, robot: RobotId) -> None:
        """Append *robot* behind the others of its tenant."""
        self._tenants.setdefault(robot.tenant, deque()).append(robot)
        self._count += 1

    def popleft(self) -> RobotId:
        """Return the robot whose turn it is; its tenant waits for all others then."""
        tenant, robots = next(iter(self._tenants.items()))
        robot = robots.popleft()
        self._count -= 1
        if robots:
            self._tenants.move_to_end(tenant)
        else:
            del self._tenants[tenant]
        return robot

    def remove(self, robot: RobotId) -> None:
        """Remove *robot* from the queue."""
        robots = self._tenants[robot.tenant]
        robots.remove(robot)
        self._count -= 1
        if not robots:
            del self._tenants[robot.tenant]

    def before(self, tenant: str) -> int:
        """Return how many turns, at most, come before that of one more robot of *tenant*."""
        own = len(self._tenants.get(tenant, ()))
        return own + sum(
            min(len(robots), own + 1) for other, robots in self._tenants.items() if other != tenant
        )
