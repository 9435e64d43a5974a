"""Decide whether a request of a robot is accepted: by its rate, its requests in progress, and bodies in
memory.

1. Rate: each robot has a token bucket, and a request takes as many tokens as its route costs.
2. Requests in progress: at most `MAX_REQUESTS_PER_ROBOT` of a robot.
3. Bodies in memory: at most ``data.max_uploads`` of all robots, and a share of them for one robot and one
   tenant. When all places are taken, the slowest body of the robot that holds most places, of the tenant that
   holds most, is refused in favour of the new one.

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

_BURST_S = 4.0  # size of a robot's token bucket: the requests of this time may come at once
_MAX_ROBOTS = 10_000  # robots whose buckets are remembered
MAX_REQUESTS_PER_ROBOT = 8  # requests of one robot in progress; more are refused
_BODIES_PER_ROBOT = 0.25  # of ``data.max_uploads``
_BODIES_PER_TENANT = 0.75  # of ``data.max_uploads``
_RETRY_AFTER_MS = 1000.0  # after a refusal for lack of a place: most bodies are received within this time
_REFUSED_BYTES = 64 << 10  # bytes of a refused body that take one token, because they are read and dropped
_REFUSED_COST = 32.0  # most tokens that one refused body takes: those of 2 MiB

CPU_S_PER_REQUEST = 0.005  # CPU seconds that one token pays for; more work takes further tokens afterwards


@dataclass(slots=True)
class _Robot:
    bucket: TokenBucket
    requests: int = 0


class RequestLimits:
    """The requests of all robots that one data server works on; used by one thread."""

    def __init__(self, settings: DataSettings) -> None:
        self._settings = settings
        self._robots: OrderedDict[RobotId, _Robot] = OrderedDict()
        self._in_progress: dict[HttpRequest, RobotId] = {}
        self._bodies: dict[HttpRequest, RobotId] = {}
        """The requests that have a place for their body."""

    @property
    def known_robots(self) -> int:
        """How many robots are remembered; bounded, however many send."""
        return len(self._robots)

    def begin(self, request: HttpRequest, robot: RobotId, cost: float, now: float, *, has_body: bool) -> None:
        """Accept a request of *robot* until `end`; a request whose body gets no place takes its tokens, too.

        Args:
            request: The request.
            robot: The robot that sends it.
            cost: Number of tokens that it takes.
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
        wait_s = state.bucket.wait_s(now)
        if wait_s:
            raise TooManyRequests(
                f"this robot sends more than {self._settings.max_requests_per_s:g} requests a second",
                hint="send fewer and larger ones",
                retry_after_ms=1000 * wait_s,
            )
        state.bucket.spend(cost, now)
        if has_body:
            self._make_room(robot, now)
            self._bodies[request] = robot
        state.requests += 1
        self._in_progress[request] = robot

    def end(self, request: HttpRequest) -> None:
        """Free the places of a request; its tokens stay taken."""
        robot = self._in_progress.pop(request, None)
        if robot is not None:
            self._robots[robot].requests -= 1
            self._bodies.pop(request, None)

    def charge_refused(self, robot: RobotId, body_bytes: int, now: float) -> None:
        """Take tokens for the body of an accepted request that was refused later, since it was read for
        nothing.

        Bodies that `begin` refuses take none: their connections pause.

        Args:
            robot: The robot that sent it.
            body_bytes: Length of the body, received or announced.
            now: Monotonic seconds.
        """
        self._state_of(robot, now).bucket.spend(min(body_bytes / _REFUSED_BYTES, _REFUSED_COST), now)

    def charge_cpu(self, robot: RobotId, cpu_s: float, paid: float, now: float) -> None:
        """Take further tokens for the CPU time of a request, beyond those that it took when it began.

        One request takes at most a whole bucket, because the first request for a map has to read that map.

        Args:
            robot: The robot that sent it.
            cpu_s: CPU seconds of the request.
            paid: Tokens that it took when it began.
            now: Monotonic seconds.
        """
        bucket = self._state_of(robot, now).bucket
        bucket.spend(max(0.0, min(cpu_s / CPU_S_PER_REQUEST, bucket.burst) - paid), now)

    def _make_room(self, robot: RobotId, now: float) -> None:
        """Free a place for a body of *robot* if it has none left; raises Busy."""
        of_robot = Counter(self._bodies.values())
        of_tenant = Counter(holder.tenant for holder in self._bodies.values())
        most = self._settings.max_uploads
        limits = (
            (of_robot[robot], _share(most, _BODIES_PER_ROBOT), "this robot"),
            (of_tenant[robot.tenant], _share(most, _BODIES_PER_TENANT), "this tenant"),
            (len(self._bodies), most, "all robots"),
        )
        reached = next((limit for limit in limits if limit[0] >= limit[1]), None)
        if reached is None:
            return
        # A complete body keeps its place: it is being processed, and waits for no client.
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
        # With one place fewer the holder must still have as many as this robot; otherwise both would lose
        # their places in alternation.
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
        """Forget the robot without requests for longest whose bucket is full, if there are too many."""
        if len(self._robots) > _MAX_ROBOTS:
            for robot, state in self._robots.items():
                if not state.requests and state.bucket.is_full(now):
                    del self._robots[robot]
                    return


def _share(most: int, share: float) -> int:
    return max(1, int(most * share))
