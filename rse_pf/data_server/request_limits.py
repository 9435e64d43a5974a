"""Decide whether a robot's request is taken now: its rate, its requests in progress, and bodies in memory.

What one robot sends never uses up what others need: every limit is kept for each robot, and the memory for
bodies, which all share, is limited for each robot and each tenant, too.  Time is an argument.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass

from rse_pf.config import DataSettings
from rse_pf.data_server.http import TooManyRequests
from rse_pf.errors import Busy
from rse_pf.identity import RobotId
from rse_pf.token_bucket import TokenBucket

__all__ = ["RequestLimits"]

_BURST_S = 4.0
"""A robot may make the requests of this time at once."""
_MAX_ROBOTS = 10_000
MAX_REQUESTS_PER_ROBOT = 8
"""Requests of one robot in progress; more are refused."""
_BODIES_PER_ROBOT, _BODIES_PER_TENANT = 0.25, 0.75
"""Shares of ``data.max_uploads``."""
_RETRY_AFTER_MS = 1000.0
_REFUSED_BYTES, _REFUSED_COST = 64 << 10, 32.0
"""So many bytes of a refused body count as one request more, and one refusal as this many more at most."""

CPU_S_PER_REQUEST = 0.005
"""A request whose work took more CPU time than its cost in requests counts by its CPU time."""


@dataclass(slots=True)
class _Robot:
    bucket: TokenBucket
    requests: int = 0
    bodies: int = 0


class RequestLimits:
    """The requests of all robots that one data server works on; used by one thread."""

    def __init__(self, settings: DataSettings) -> None:
        self._settings = settings
        self._robots: OrderedDict[RobotId, _Robot] = OrderedDict()
        self._tenant_bodies: Counter[str] = Counter()

    @property
    def known_robots(self) -> int:
        """How many robots are remembered; bounded, however many send."""
        return len(self._robots)

    def begin(self, robot: RobotId, cost: float, now: float, *, has_body: bool) -> None:
        """Take a request of *robot*, which `end` gives back.

        Args:
            robot: Who sends it.
            cost: How many plain requests it counts for.
            now: Monotonic seconds.
            has_body: Whether its body will be held in memory.

        Raises:
            TooManyRequests: The robot's rate or its requests in progress are at their limit.
            Busy: Too many bodies are being received, of this robot, its tenant or all.
        """
        state = self._state_of(robot, now)
        if state.requests >= MAX_REQUESTS_PER_ROBOT:
            raise TooManyRequests(
                f"{state.requests} requests of this robot are in progress, the limit is "
                f"{MAX_REQUESTS_PER_ROBOT}",
                hint="wait for their replies",
                retry_after_ms=_RETRY_AFTER_MS,
            )
        if has_body:
            self._check_bodies(state, robot.tenant)
        wait_s = state.bucket.wait_s(now)
        if wait_s:
            raise TooManyRequests(
                f"this robot sends more than {self._settings.max_requests_per_s:g} requests a second",
                hint="send fewer and larger ones",
                retry_after_ms=1000 * wait_s,
            )
        state.bucket.spend(cost, now)
        state.requests += 1
        if has_body:
            state.bodies += 1
            self._tenant_bodies[robot.tenant] += 1

    def charge_refused(self, robot: RobotId, body_bytes: int, now: float) -> None:
        """Count the body of a request that was refused: it is read and dropped, which takes time from others.

        Args:
            robot: Who sent it, whose request has begun.
            body_bytes: How long the body is, or says that it is.
            now: Monotonic seconds.
        """
        self._state_of(robot, now).bucket.spend(min(body_bytes / _REFUSED_BYTES, _REFUSED_COST), now)

    def charge_cpu(self, robot: RobotId, cpu_s: float, paid: float, now: float) -> None:
        """Count the CPU time of a request's work, beyond what it counted for when it began.

        One request counts for no more than what may come at once: the first one of a map reads that map.

        Args:
            robot: Who sent it.
            cpu_s: CPU seconds.
            paid: The cost with which it began.
            now: Monotonic seconds.
        """
        bucket = self._state_of(robot, now).bucket
        bucket.spend(max(0.0, min(cpu_s / CPU_S_PER_REQUEST, bucket.burst) - paid), now)

    def end(self, robot: RobotId, *, has_body: bool) -> None:
        """Give back what `begin` took, except for the rate."""
        state = self._robots[robot]
        state.requests -= 1
        if has_body:
            state.bodies -= 1
            self._tenant_bodies[robot.tenant] -= 1
            if not self._tenant_bodies[robot.tenant]:
                del self._tenant_bodies[robot.tenant]

    def _check_bodies(self, state: _Robot, tenant: str) -> None:
        most = self._settings.max_uploads
        limits = (
            (state.bodies, _share(most, _BODIES_PER_ROBOT), "this robot"),
            (self._tenant_bodies[tenant], _share(most, _BODIES_PER_TENANT), "this tenant"),
            (self._tenant_bodies.total(), most, "all robots"),
        )
        for count, limit, whose in limits:
            if count >= limit:
                raise Busy(
                    f"{count} uploads of {whose} are in progress, the limit is {limit}",
                    hint="retry later",
                    retry_after_ms=_RETRY_AFTER_MS,
                )

    def _state_of(self, robot: RobotId, now: float) -> _Robot:
        state = self._robots.get(robot)
        if state is None:
            rate = self._settings.max_requests_per_s
            state = self._robots[robot] = _Robot(TokenBucket(rate, burst=rate * _BURST_S))
            self._forget_one(now)
        self._robots.move_to_end(robot)
        return state

    def _forget_one(self, now: float) -> None:
        """Forget the robot that has been quiet for longest; its bucket is full again in all likelihood."""
        if len(self._robots) > _MAX_ROBOTS:
            for robot, state in self._robots.items():
                if not state.requests and state.bucket.is_full(now):
                    del self._robots[robot]
                    return


def _share(most: int, share: float) -> int:
    return max(1, int(most * share))
