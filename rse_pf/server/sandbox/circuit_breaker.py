"""Decide which requests and services are not run again after crashes, and for whom.

Evidence is kept for each robot first.  A service whose sandboxes of one robot ended ``breaker_crashes`` times
within `WINDOW_S` is refused to that robot for `OPEN_S`: its circuit breaker is open.  A request
that crashed `POISON_CRASHES` sandboxes of one robot is poison for it until `POISON_S` have passed.
Both hold for others only when their sandboxes crashed as well:

- for a tenant, when the crashes are those of at least `ROBOTS_OF_A_TENANT` robots of it;
- for all, when they are those of at least as many robots, and at least `ROBOTS_OF_OTHERS` of these do not
  belong to the tenant that has the most of them.  No tenant can take a service from another one.

A sandbox that was killed because its robot's deadline had passed did not crash.  Such overruns count for
that robot alone, and never make a request poison.  Time is an argument, it never goes back, and memory is
bounded whatever robots send.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Literal, NamedTuple

from rse_pf.config import ServiceSettings
from rse_pf.errors import Poison, WorkerLost
from rse_pf.identity import RobotId

__all__ = [
    "OPEN_S",
    "POISON_S",
    "ROBOTS_OF_A_TENANT",
    "ROBOTS_OF_OTHERS",
    "WINDOW_S",
    "Block",
    "CircuitBreaker",
]

WINDOW_S = 30.0
"""``services.breaker_crashes`` within this open the circuit breaker."""
OPEN_S = 60.0
"""Time that the circuit breaker of a service stays open."""
POISON_CRASHES = 2
"""A request that crashed this many sandboxes is poison: dead-letter queues count so, too."""
POISON_S = 600.0
"""A request is tried again this long after the crashes that made it poison."""
ROBOTS_OF_A_TENANT = 3
ROBOTS_OF_OTHERS = 2
_MAX_REQUESTS = 10_000
_MAX_ENDS_OF_REQUEST = 32
_MAX_ENDS_OF_SERVICE = 1024
_MAX_BREAKERS = 10_000
_MAX_REQUESTS_LISTED = 1000
"""So that an operator's question does not hold up the worker, whatever robots have sent."""

Reason = Literal["crashes", "overruns", "poison"]
Scope = RobotId | str | None
"""For whom something is refused: one robot, the robots of a tenant (its name), or all (None)."""


class _End(NamedTuple):
    at_s: float
    robot: RobotId
    is_crash: bool = True


class _Breaker(NamedTuple):
    opened_s: float
    until_s: float
    overruns: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """What is refused to whom, as an operator reads it.

    Attributes:
        service: Its name.
        reason: "crashes" or "overruns" for an open circuit breaker, "poison" for requests.
        tenant: For whom; None means all tenants.
        robot: Its name; None means all robots of the tenant.
        requests: Number of requests that are poison, of the latest thousand; 0 for a circuit breaker.
        left_s: Seconds until the last of it ends.
    """

    service: str
    reason: Reason
    tenant: str | None
    robot: str | None
    requests: int
    left_s: float


class CircuitBreaker:
    """What one worker knows of crashing requests and services."""

    def __init__(self, settings: ServiceSettings, *, poison_crashes: int = POISON_CRASHES) -> None:
        self._settings = settings
        self._poison_crashes = poison_crashes
        self._ends_of_request: OrderedDict[tuple[str, str], tuple[_End, ...]] = OrderedDict()
        self._ends_of_service: dict[str, deque[_End]] = {}
        self._breakers: dict[tuple[str, Scope], _Breaker] = {}

    def refusal(self, robot: RobotId, service: str, digest: str, now: float) -> Poison | WorkerLost | None:
        """Return why *robot* may not run the request with this digest now, None if it may."""
        ends = self._ends_of_request.get((service, digest), ())
        if ends and any(self._poison_until(scope, ends) > now for scope in _scopes_of(robot)):
            return Poison(
                "this request crashed every sandbox that ran it and is not tried again",
                hint="send another one; the server's log has the crash",
            )
        if not self._breakers:
            return None
        candidates = [self._breakers.get((service, scope)) for scope in _scopes_of(robot)]
        present = (breaker for breaker in candidates if breaker)
        last = max(present, key=lambda breaker: breaker.until_s, default=None)
        if last is None or last.until_s <= now:
            return None
        return _refusal_of(service, last, last.until_s - now)

    def note_crash(self, robot: RobotId, service: str, digest: str, now: float) -> None:
        """Note that a sandbox of *robot* crashed while it worked on this request."""
        end, key = _End(now, robot), (service, digest)
        self._count(service, end)
        before = self._ends_of_request.pop(key, ())
        self._ends_of_request[key] = (*before, end)[-_MAX_ENDS_OF_REQUEST:]
        while len(self._ends_of_request) > _MAX_REQUESTS or self._oldest_s() <= now - POISON_S:
            self._ends_of_request.popitem(last=False)

    def note_overrun(self, robot: RobotId, service: str, now: float) -> None:
        """Note that a sandbox was killed because *robot*'s own deadline had passed."""
        self._count(service, _End(now, robot, is_crash=False))

    def open_services(self, now: float) -> list[str]:
        """Return the services that are refused now to more than one robot, sorted."""
        shared = (key for key, breaker in self._breakers.items() if breaker.until_s > now)
        return sorted({service for service, scope in shared if not isinstance(scope, RobotId)})

    def blocks(self, now: float) -> list[Block]:
        """Return all blocks of now, those of most robots first, and then by name."""
        blocks = [
            _block(service, scope, "overruns" if breaker.overruns else "crashes", 0, breaker.until_s - now)
            for (service, scope), breaker in self._breakers.items()
            if breaker.until_s > now
        ]
        poison: dict[tuple[str, Scope], list[float]] = {}
        for (service, _), ends in islice(reversed(self._ends_of_request.items()), _MAX_REQUESTS_LISTED):
            for scope in {scope for end in ends for scope in _scopes_of(end.robot)}:
                until_s = self._poison_until(scope, ends)
                if until_s > now:
                    poison.setdefault((service, scope), []).append(until_s - now)
        blocks += [_block(*key, "poison", len(lefts), max(lefts)) for key, lefts in poison.items()]
        return sorted(
            blocks, key=lambda block: (block.robot or "", block.tenant or "", block.service, block.reason)
        )

    def unblock(
        self, now: float, *, service: str | None = None, tenant: str | None = None, robot: str | None = None
    ) -> list[Block]:
        """Lift the matching blocks, forget the evidence for them, and return them.

        Args:
            now: The time.
            service: Its name; None means every service.
            tenant: Lift only what concerns this tenant or a robot of it; None means everything.
            robot: Name of a robot of *tenant*; lift only what concerns this robot.
        """

        def matches(name: str, block_tenant: str | None, block_robot: str | None) -> bool:
            return service in (None, name) and tenant in (None, block_tenant) and robot in (None, block_robot)

        lifted = [block for block in self.blocks(now) if matches(block.service, block.tenant, block.robot)]

        def without_lifted(name: str, ends: Iterable[_End]) -> list[_End]:
            return [end for end in ends if not matches(name, end.robot.tenant, end.robot.name)]

        for key in [key for key in self._breakers if matches(key[0], *_tenant_and_name(key[1]))]:
            del self._breakers[key]
        for name, service_ends in self._ends_of_service.items():
            self._ends_of_service[name] = deque(without_lifted(name, service_ends), _MAX_ENDS_OF_SERVICE)
        for request, request_ends in list(self._ends_of_request.items()):
            if remaining := without_lifted(request[0], request_ends):
                self._ends_of_request[request] = tuple(remaining)
            else:
                del self._ends_of_request[request]
        return lifted

    def _count(self, service: str, end: _End) -> None:
        """Count the *end* of a sandbox for and against everybody whom it may concern."""
        ends = self._ends_of_service.setdefault(service, deque(maxlen=_MAX_ENDS_OF_SERVICE))
        ends.append(end)
        while ends[0].at_s < end.at_s - WINDOW_S:
            ends.popleft()
        for scope in _scopes_of(end.robot):
            before = self._breakers.get((service, scope))
            opened_s = -math.inf if before is None else before.opened_s
            since_s = _evidence_since(scope, ends, self._settings.breaker_crashes)
            if since_s > opened_s:
                self._open(service, scope, end)

    def _open(self, service: str, scope: Scope, last: _End) -> None:
        now = last.at_s
        self._breakers = {
            key: breaker
            for key, breaker in self._breakers.items()
            if max(breaker.until_s, breaker.opened_s + WINDOW_S) > now
        }
        self._breakers.pop((service, scope), None)
        self._breakers[service, scope] = _Breaker(now, now + OPEN_S, not last.is_crash)
        if len(self._breakers) > _MAX_BREAKERS:
            del self._breakers[next(iter(self._breakers))]

    def _poison_until(self, scope: Scope, ends: tuple[_End, ...]) -> float:
        return _evidence_since(scope, ends, self._poison_crashes) + POISON_S

    def _oldest_s(self) -> float:
        return next(iter(self._ends_of_request.values()))[-1].at_s


def _evidence_since(scope: Scope, ends: Sequence[_End], count: int) -> float:
    """Return when the shortest run of the latest *ends* begins that is evidence in *scope*; -inf for none."""
    robots, ends_in_scope = set[RobotId](), 0
    for end in reversed(ends):
        if scope in _scopes_of(end.robot) and (end.is_crash or isinstance(scope, RobotId)):
            ends_in_scope += 1
            robots.add(end.robot)
            if ends_in_scope >= count and _is_wide_enough(scope, robots):
                return end.at_s
    return -math.inf


def _is_wide_enough(scope: Scope, robots: set[RobotId]) -> bool:
    if isinstance(scope, RobotId):
        return True
    if len(robots) < ROBOTS_OF_A_TENANT:
        return False
    of_the_largest_tenant = max(Counter(robot.tenant for robot in robots).values())
    return scope is not None or len(robots) - of_the_largest_tenant >= ROBOTS_OF_OTHERS


def _scopes_of(robot: RobotId) -> tuple[Scope, ...]:
    return robot, robot.tenant, None


def _tenant_and_name(scope: Scope) -> tuple[str | None, str | None]:
    """Return tenant and name of the robots of *scope*, None where they are any."""
    return (scope.tenant, scope.name) if isinstance(scope, RobotId) else (scope, None)


def _block(service: str, scope: Scope, reason: Reason, requests: int, left_s: float) -> Block:
    tenant, robot = _tenant_and_name(scope)
    return Block(
        service=service, reason=reason, tenant=tenant, robot=robot, requests=requests, left_s=round(left_s, 3)
    )


def _refusal_of(service: str, breaker: _Breaker, left_s: float) -> WorkerLost:
    if breaker.overruns:
        how = "was killed repeatedly, because it took more than twice the deadline,"
        hint = "allow it more time: send a longer deadline"
    else:
        how = "crashed repeatedly"
        hint = "tell the operator; the server's log has the crashes"
    return WorkerLost(
        f"service {service!r} {how} and is refused for another {left_s:.0f} s",
        hint=hint,
        retry_after_ms=left_s * 1e3,
    )
