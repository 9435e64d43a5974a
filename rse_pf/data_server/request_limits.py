"""Accept or refuse a robot's request, by its rate, its requests in progress, and the bodies held in memory.

1. Rate: each robot has a token bucket, and a request takes as many tokens as its route costs.
2. Requests in progress: at most `MAX_REQUESTS_PER_ROBOT` of one robot.
3. Bodies in memory: at most ``data.max_uploads`` bodies of all robots, and a fraction of that number of one
   robot and of one tenant.  At a limit of all robots or of a tenant, a new body may displace another one that
   is still being received: the slowest body of the robot with most bodies, of the tenant with most bodies.
   The displaced request is refused.

Time is an argument.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass

from rse_pf.config import DataSettings
from rse_pf.data_server.http import HttpRequest, TooManyRequests
from rse_pf.errors import Busy
from rse_pf.identity import RobotId
from rse_pf.limits.token_bucket import TokenBucket

__all__ = ["RequestLimits"]

_BURST_S = 4.0  # size of a token bucket: a robot may send the requests of 4 s at its full rate at once
_MAX_ROBOTS = 10_000  # number of robots whose token buckets are remembered, to bound memory
MAX_REQUESTS_PER_ROBOT = 8  # requests of one robot in progress at a time; more are refused
_ROBOT_BODIES_FRACTION = 0.25  # fraction of ``data.max_uploads`` that the bodies of one robot may hold
_TENANT_BODIES_FRACTION = 0.75  # fraction of ``data.max_uploads`` that the bodies of one tenant may hold
_RETRY_AFTER_MS = 1000.0  # Retry-After of a refusal at a limit on requests or bodies: most end within 1 s
_REFUSED_BYTES_PER_TOKEN = 64 << 10  # a body that is read and then refused costs one token for each 64 KiB
_MAX_REFUSED_TOKENS = 32.0  # most tokens that one refused body costs: those of 2 MiB

CPU_S_PER_REQUEST = 0.005  # CPU seconds that one token pays for; more CPU time costs tokens afterwards


@dataclass(slots=True)
class _Robot:
    bucket: TokenBucket
    requests: int = 0


class RequestLimits:
    """The limits on the requests of all robots to one data server; only the event loop's thread uses it."""

    def __init__(self, settings: DataSettings) -> None:
        self._settings = settings
        self._robots: OrderedDict[RobotId, _Robot] = OrderedDict()
        self._in_progress: dict[HttpRequest, RobotId] = {}
        self._bodies: dict[HttpRequest, RobotId] = {}
        """Requests whose bodies may be held in memory, with their robots; at most ``data.max_uploads``."""

    @property
    def known_robots(self) -> int:
        """The number of robots whose token buckets are remembered; about `_MAX_ROBOTS` at most."""
        return len(self._robots)

    def begin(self, request: HttpRequest, robot: RobotId, cost: float, now: float, *, has_body: bool) -> None:
        """Accept *request* of *robot* and count it as in progress until `end`, or raise an error.

        A request that is refused with Busy takes its tokens nevertheless.

        Args:
            request: The request.
            robot: The robot that sends it.
            cost: Number of tokens that the request takes from the robot's bucket.
            now: Monotonic seconds.
            has_body: Whether the body of the request will be held in memory.

        Raises:
            TooManyRequests: The robot's bucket is empty, or too many of its requests are in progress.
            Busy: Too many bodies of this robot, of its tenant or of all robots are held in memory.
        """
        state = self._state_of(robot, now)
        if state.requests >= MAX_REQUESTS_PER_ROBOT:
            raise TooManyRequests(
                f"{state.requests} requests of this robot are in progress, the limit is "
                f"{MAX_REQUESTS_PER_ROBOT}",
                hint="wait for their replies",
                retry_after_ms=_RETRY_AFTER_MS,
            )
        wait_s = state.bucket.wait_s(now)
        if wait_s:
            raise TooManyRequests(
                f"this robot sends more than {self._settings.max_requests_per_s:g} requests a second",
                hint="send fewer and larger ones",
                retry_after_ms=1000 * wait_s,
            )
        state.bucket.spend(cost, now)
        if has_body:
            self._free_body_place(robot, now)
            self._bodies[request] = robot
        state.requests += 1
        self._in_progress[request] = robot

    def end(self, request: HttpRequest) -> None:
        """Count *request* and its body no longer as in progress; the tokens that it took are not returned.

        A request that was not accepted is ignored.
        """
        robot = self._in_progress.pop(request, None)
        if robot is not None:
            self._robots[robot].requests -= 1
            self._bodies.pop(request, None)

    def charge_refused(self, robot: RobotId, body_bytes: int, now: float) -> None:
        """Take tokens for the body of a request that `begin` accepted and its handler refused.

        Such a body was read for nothing.  A request that `begin` refuses costs no tokens for its body: the
        caller delays the reply instead.

        Args:
            robot: The robot that sent the request.
            body_bytes: Length of the body, received or announced.
            now: Monotonic seconds.
        """
        self._state_of(robot, now).bucket.spend(
            min(body_bytes / _REFUSED_BYTES_PER_TOKEN, _MAX_REFUSED_TOKENS), now
        )

    def charge_cpu(self, robot: RobotId, cpu_s: float, paid: float, now: float) -> None:
        """Take further tokens for a request that used more CPU time than its tokens paid for.

        One request costs at most as many tokens as the bucket holds, because the first request for a map also
        pays for reading that map.

        Args:
            robot: The robot that sent the request.
            cpu_s: CPU seconds that the request used.
            paid: Tokens that the request took in `begin`.
            now: Monotonic seconds.
        """
        bucket = self._state_of(robot, now).bucket
        bucket.spend(max(0.0, min(cpu_s / CPU_S_PER_REQUEST, bucket.burst) - paid), now)

    def _free_body_place(self, robot: RobotId, now: float) -> None:
        """Displace another body if a limit leaves no place for one more body of *robot*; raises Busy.

        Busy: *robot* is at its own limit, or no body is being received whose robot or tenant holds at least
        two places more.
        """
        of_robot = Counter(self._bodies.values())
        of_tenant = Counter(holder.tenant for holder in self._bodies.values())
        most = self._settings.max_uploads
        limits = (
            (of_robot[robot], _fraction_of(most, _ROBOT_BODIES_FRACTION), "this robot"),
            (of_tenant[robot.tenant], _fraction_of(most, _TENANT_BODIES_FRACTION), "this tenant"),
            (len(self._bodies), most, "all robots"),
        )
        reached = next((limit for limit in limits if limit[0] >= limit[1]), None)
        if reached is None:
            return
        # Only a body that is still being received may be displaced; a complete one is being processed.
        receiving = [
            (request, holder)
            for request, holder in self._bodies.items()
            if request.is_receiving and (holder.tenant == robot.tenant or reached is limits[-1])
        ]

        def claim(body: tuple[HttpRequest, RobotId]) -> tuple[int, int, float]:
            request, holder = body
            return of_tenant[holder.tenant], of_robot[holder], -request.received_bytes_per_s(now)

        slowest, holder = max(receiving, key=claim, default=(None, robot))
        is_other_tenant = holder.tenant != robot.tenant
        held = of_tenant[holder.tenant] if is_other_tenant else of_robot[holder]
        own = of_tenant[robot.tenant] if is_other_tenant else of_robot[robot]
        # After the exchange the holder must still have at least as many places as this robot (or tenant);
        # otherwise the two would displace each other's bodies in alternation.
        if slowest is None or held < own + 2 or reached is limits[0]:
            count, limit, whose = reached
            raise Busy(
                f"{count} request bodies of {whose} are in progress, the limit is {limit}",
                hint="retry later",
                retry_after_ms=_RETRY_AFTER_MS,
            )
        del self._bodies[slowest]
        slowest.end_body(
            Busy(
                f"the body came at {slowest.received_bytes_per_s(now):.0f} bytes a second, and another robot "
                "needed its place",
                hint="send it again in smaller parts",
                retry_after_ms=_RETRY_AFTER_MS,
            )
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
        """Above `_MAX_ROBOTS` robots, forget the longest silent one with a full bucket and no request."""
        if len(self._robots) > _MAX_ROBOTS:
            for robot, state in self._robots.items():
                if not state.requests and state.bucket.is_full(now):
                    del self._robots[robot]
                    return


def _fraction_of(most: int, fraction: float) -> int:
    return max(1, int(most * fraction))
