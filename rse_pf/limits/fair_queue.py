"""Choose the next item of a queue: fair between tenants, then between the robots of a tenant.

This is hierarchical fair queueing by round robin, with two levels:

1. The tenant with the fewest running items is served next; of several such tenants, the one that has waited
   longest since it was added, or since one of its items began or ended.
2. Within that tenant, a robot is chosen by the same rule.
3. The items of a robot are served first in, first out.

A tenant with many robots, or with slow work, therefore never runs more items than another tenant whose items
wait.  This module uses no thread and no clock.

Source:
    Nagle 1987, On packet switches with infinite storage (fair queueing by round robin).
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from typing import Any, Generic, TypeVar

from rse_pf.identity import RobotId

__all__ = ["FairQueue", "largest_holder"]

Item = TypeVar("Item")


class FairQueue(Generic[Item]):
    """The waiting items of all robots, and the numbers of running items of each tenant and each robot.

    Items of a robot or tenant that has as many running items as its maximum wait.
    """

    def __init__(self, *, max_running_per_robot: float = math.inf, max_running_per_tenant: float = math.inf):
        self._max_per_robot = max_running_per_robot
        self._max_per_tenant = max_running_per_tenant
        self._tenants: OrderedDict[str, OrderedDict[RobotId, deque[Item]]] = OrderedDict()
        self._running: Counter[Hashable] = Counter()  # running items by robot, and by tenant
        self._count = 0

    def __len__(self) -> int:
        """Return the number of waiting items."""
        return self._count

    def __iter__(self) -> Iterator[Item]:
        """Yield the waiting items, grouped by robot."""
        for robots in self._tenants.values():
            for items in robots.values():
                yield from items

    def items_of(self, robot: RobotId) -> deque[Item]:
        """Return the waiting items of *robot* in their order; the caller may replace items in it."""
        robots = self._tenants.get(robot.tenant)
        return deque() if robots is None else robots.get(robot, deque())

    def add(self, robot: RobotId, item: Item) -> None:
        """Add *item* behind the other waiting items of *robot*."""
        self._tenants.setdefault(robot.tenant, OrderedDict()).setdefault(robot, deque()).append(item)
        self._count += 1

    def peek(self) -> Item | None:
        """Return the next item without removing it; None if no item waits, or none of those may run."""
        robot = self._next(self._max_per_tenant)
        return None if robot is None else self._tenants[robot.tenant][robot][0]

    def take(self, *, only_newcomers: bool = False) -> Item | None:
        """Remove the next item and return it; it counts as running until `release` is called.

        None if no item waits, or none of those may run.  With *only_newcomers*, only items of tenants without
        a running item may run.
        """
        robot = self._next(1 if only_newcomers else self._max_per_tenant)
        if robot is None:
            return None
        robots = self._tenants[robot.tenant]
        item = robots[robot].popleft()
        self._count -= 1
        self._running[robot] += 1
        self._running[robot.tenant] += 1
        robots.move_to_end(robot)
        self._tenants.move_to_end(robot.tenant)
        self._forget_empty(robot)
        return item

    def release(self, robot: RobotId) -> None:
        """Note that a running item of *robot* ended, and put robot and tenant behind the others that wait."""
        for key in (robot, robot.tenant):
            self._running[key] -= 1
            if not self._running[key]:
                del self._running[key]
        robots = self._tenants.get(robot.tenant)
        if robots is not None:
            self._tenants.move_to_end(robot.tenant)
            if robot in robots:
                robots.move_to_end(robot)

    def remove(self, is_gone: Callable[[Item], bool]) -> list[Item]:
        """Remove and return the waiting items for which *is_gone* returns True."""
        removed: list[Item] = []
        for robots in list(self._tenants.values()):
            for robot, items in list(robots.items()):
                gone = [item for item in items if is_gone(item)]
                if gone:
                    removed += gone
                    robots[robot] = deque(item for item in items if not is_gone(item))
                    self._count -= len(gone)
                    self._forget_empty(robot)
        return removed

    def position(self, robot: RobotId) -> int:
        """Return the last possible position (1 is next) of one more item of *robot* in the queue.

        Before each item of the robot, at most one item of each other robot of its tenant is served, and
        before each of these at most one item of each other tenant.  The position is a bound if one item runs
        at a time and no other item is added; otherwise it is an estimate.
        """
        robots = self._tenants.get(robot.tenant, OrderedDict[RobotId, deque[Item]]())
        rounds = 1 + len(robots.get(robot, ()))
        tenants = len(self._tenants) + (not robots)
        return min(1 + self._count, rounds * (len(robots) + (robot not in robots)) * tenants)

    def _next(self, max_per_tenant: float) -> RobotId | None:
        """Return the robot whose item is next; only tenants with fewer running items than this are served."""
        best, fewest = None, max_per_tenant
        for tenant, robots in self._tenants.items():
            running = self._running[tenant]
            if running < fewest:
                robot = self._next_robot(robots)
                if robot is not None:
                    best, fewest = robot, running
                    if not running:
                        break
        return best

    def _next_robot(self, robots: Iterable[RobotId]) -> RobotId | None:
        best, fewest = None, self._max_per_robot
        for robot in robots:
            running = self._running[robot]
            if running < fewest:
                best, fewest = robot, running
                if not running:
                    break
        return best

    def _forget_empty(self, robot: RobotId) -> None:
        robots = self._tenants[robot.tenant]
        if not robots[robot]:
            del robots[robot]
        if not robots:
            del self._tenants[robot.tenant]


def largest_holder(
    held: Mapping[RobotId, int], newcomer: RobotId, may_give: Callable[[RobotId], Any]
) -> RobotId | None:
    """Return the robot that has to give one place to *newcomer* when all places are taken.

    It is the robot with the most places within the tenant with the most places.  Only a robot of the same
    tenant that has at least two more places than *newcomer*, or of another tenant that has at least two more
    places than the tenant of *newcomer*, has to give one: with one more, the two would only swap.

    Args:
        held: Number of places of each robot.
        newcomer: The robot that needs one more place.
        may_give: Returns whether a robot can give a place now.

    Returns:
        The robot, or None if no robot has to give a place, so that *newcomer* is refused.
    """
    of_tenant: Counter[str] = Counter()
    for robot, count in held.items():
        of_tenant[robot.tenant] += count

    def has_two_more(robot: RobotId) -> bool:
        if robot.tenant == newcomer.tenant:
            return held[robot] > held.get(newcomer, 0) + 1
        return of_tenant[robot.tenant] > of_tenant[newcomer.tenant] + 1

    donors = (robot for robot in held if has_two_more(robot) and may_give(robot))
    return max(donors, key=lambda robot: (of_tenant[robot.tenant], held[robot]), default=None)
