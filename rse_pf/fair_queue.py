"""Decide whose work is next: fair between tenants, then between the robots of a tenant.

The tenant with the fewest running items goes first, of several the one that was served least recently; within
a tenant the same holds for its robots.  So a tenant with many robots, or with slow work, takes no more than
another tenant that waits.  The items of a robot keep their order.

Pure: no thread and no clock.  Queues that never ask how long their front has waited may leave the time out.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from rse_pf.identity import RobotId

__all__ = ["FairQueue", "largest_holder"]

Item = TypeVar("Item")


@dataclass(slots=True)
class _Robot(Generic[Item]):
    since_s: float
    """When the robot was served last, or began to wait."""
    items: deque[Item] = field(default_factory=deque)


@dataclass(slots=True)
class _Tenant(Generic[Item]):
    since_s: float
    robots: OrderedDict[RobotId, _Robot[Item]] = field(default_factory=OrderedDict)
    """The robots that have waiting items, the least recently served one first."""


class FairQueue(Generic[Item]):
    """Items that wait, and how many of each tenant and robot run."""

    def __init__(self, *, max_running_per_robot: float = math.inf, max_running_per_tenant: float = math.inf):
        self._max_per_robot = max_running_per_robot
        self._max_per_tenant = max_running_per_tenant
        self._tenants: OrderedDict[str, _Tenant[Item]] = OrderedDict()
        self._running: Counter[Hashable] = Counter()  # by robot and by the name of the tenant
        self._count = 0

    def __len__(self) -> int:
        """Return how many items wait."""
        return self._count

    def __iter__(self) -> Iterator[Item]:
        """Yield the waiting items, grouped by robot."""
        for tenant in self._tenants.values():
            for waiting in tenant.robots.values():
                yield from waiting.items

    def items_of(self, robot: RobotId) -> deque[Item]:
        """Return the waiting items of *robot*; the caller may replace one by another."""
        tenant = self._tenants.get(robot.tenant)
        waiting = None if tenant is None else tenant.robots.get(robot)
        return deque() if waiting is None else waiting.items

    def add(self, robot: RobotId, item: Item, now: float = 0.0) -> None:
        """Let *item* wait behind the other items of *robot*."""
        tenant = self._tenants.get(robot.tenant)
        if tenant is None:
            tenant = self._tenants[robot.tenant] = _Tenant(now)
        waiting = tenant.robots.get(robot)
        if waiting is None:
            waiting = tenant.robots[robot] = _Robot(now)
        waiting.items.append(item)
        self._count += 1

    def peek(self) -> Item | None:
        """Return the next item without removing it; None if none waits or may run."""
        robot = self._next()
        return None if robot is None else self._tenants[robot.tenant].robots[robot].items[0]

    def take(self, now: float = 0.0) -> Item | None:
        """Remove the next item and return it; it runs until `release`.  None if none waits or may run."""
        robot = self._next()
        if robot is None:
            return None
        tenant = self._tenants[robot.tenant]
        waiting = tenant.robots[robot]
        item = waiting.items.popleft()
        self._count -= 1
        self._running[robot] += 1
        self._running[robot.tenant] += 1
        waiting.since_s = tenant.since_s = now
        tenant.robots.move_to_end(robot)
        self._tenants.move_to_end(robot.tenant)
        self._forget_empty(robot)
        return item

    def release(self, robot: RobotId, now: float = 0.0) -> None:
        """Note that one running item of *robot* ended."""
        for key in (robot, robot.tenant):
            self._running[key] -= 1
            if not self._running[key]:
                del self._running[key]
        tenant = self._tenants.get(robot.tenant)
        if tenant is not None and robot in tenant.robots:
            tenant.robots[robot].since_s = now

    def remove(self, is_gone: Callable[[Item], bool]) -> list[Item]:
        """Remove the waiting items of which *is_gone* holds, and return them."""
        removed: list[Item] = []
        for tenant in list(self._tenants.values()):
            for robot, waiting in list(tenant.robots.items()):
                gone = [item for item in waiting.items if is_gone(item)]
                if gone:
                    removed += gone
                    waiting.items = deque(item for item in waiting.items if not is_gone(item))
                    self._count -= len(gone)
                    self._forget_empty(robot)
        return removed

    def expected_wait_s(self, robot: RobotId, now: float) -> float:
        """Return how long one more item of *robot* will wait, by how long the front of the queue has waited.

        Source:
            Head-of-line delay estimator, Ibrahim and Whitt 2009.
        """
        if not self._count:
            return 0.0
        round_s = now - next(iter(self._tenants.values())).since_s
        tenant = self._tenants.get(robot.tenant)
        if tenant is None:
            return round_s
        first = next((each for name, each in tenant.robots.items() if name not in self._running), None)
        if first is not None:
            round_s = max(round_s, now - first.since_s)
        own = tenant.robots.get(robot)
        return round_s * (1 + (0 if own is None else len(own.items)))

    def _next(self) -> RobotId | None:
        best, fewest = None, self._max_per_tenant
        for name, tenant in self._tenants.items():
            running = self._running[name]
            if running < fewest:
                robot = self._next_robot(tenant)
                if robot is not None:
                    best, fewest = robot, running
                    if not running:
                        break
        return best

    def _next_robot(self, tenant: _Tenant[Item]) -> RobotId | None:
        best, fewest = None, self._max_per_robot
        for robot in tenant.robots:
            running = self._running[robot]
            if running < fewest:
                best, fewest = robot, running
                if not running:
                    break
        return best

    def _forget_empty(self, robot: RobotId) -> None:
        tenant = self._tenants[robot.tenant]
        if not tenant.robots[robot].items:
            del tenant.robots[robot]
        if not tenant.robots:
            del self._tenants[robot.tenant]


def largest_holder(
    held: Mapping[RobotId, int], newcomer: RobotId, may_give: Callable[[RobotId], Any]
) -> RobotId | None:
    """Return the robot that gives one place up to *newcomer* where all places are taken; None refuses it.

    It is of the tenant that holds most, and there the robot that holds most: of another tenant that holds at
    least two more than the newcomer's, or of the same tenant if it holds two more than the newcomer.  With
    one more, the two would only change places.

    Args:
        held: How many places each robot holds.
        newcomer: Who asks for one more.
        may_give: Whether a place of a robot can be given up now.
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
