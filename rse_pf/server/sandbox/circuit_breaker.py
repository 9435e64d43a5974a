"""Decide which services and requests are refused after crashes of their sandboxes, and to which robots.

- Circuit breaker: a service whose sandboxes of one robot crashed or overran ``services.breaker_crashes``
  times within `WINDOW_S` is refused to that robot for `OPEN_S`.
- Poison request: a request that crashed `POISON_CRASHES` sandboxes of one robot is refused to that robot for
  `POISON_S`.  Two requests are the same if the SHA-256 digests of their messages are equal.

Both refusals are extended to other robots only if sandboxes of several robots crashed:

- to all robots of a tenant if sandboxes of at least `MIN_ROBOTS_OF_TENANT` robots of this tenant crashed;
- to all robots if sandboxes of at least `MIN_ROBOTS_OF_TENANT` robots crashed, and at least
  `MIN_ROBOTS_OF_OTHER_TENANTS`
  of these robots do not belong to the tenant with the most such robots.  A single tenant can therefore not
  make a service unavailable to other tenants.

An overrun means that a sandbox was killed because its command took too long.  Overruns count for their robot
alone, and never make a request poison.  Time is an argument.  The numbers of crashes, requests and circuit
breakers in memory are bounded.

Source:
    Nygard 2007, "Release It!" (circuit breaker).
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
    "MIN_ROBOTS_OF_OTHER_TENANTS",
    "MIN_ROBOTS_OF_TENANT",
    "OPEN_S",
    "POISON_S",
    "WINDOW_S",
    "Block",
    "CircuitBreaker",
]

WINDOW_S = 30.0  # seconds within which ``services.breaker_crashes`` crashes or overruns open a breaker
OPEN_S = 60.0  # seconds for which an open circuit breaker refuses a service; then the service is tried again
POISON_CRASHES = 2  # crashes that make a request poison: after a crash, the request is retried once
POISON_S = 600.0  # seconds for which a request is refused as poison, from the first of the counted crashes on
# Fewest robots of one tenant with crashed sandboxes at which all robots of this tenant are refused.
MIN_ROBOTS_OF_TENANT = 3
# Fewest robots with crashed sandboxes outside the most affected tenant at which all robots are refused.
MIN_ROBOTS_OF_OTHER_TENANTS = 2
_MAX_REQUESTS = 10_000  # most requests whose crashes are stored; the one that crashed longest ago is removed
_MAX_ENDS_OF_REQUEST = 32  # most crashes that are stored for one request; the oldest is removed first
_MAX_ENDS_OF_SERVICE = 1024  # most crashes and overruns that are stored for one service; oldest removed first
_MAX_BREAKERS = 10_000  # most circuit breakers that are stored; the one that opened first is removed first
_MAX_REQUESTS_LISTED = 1000  # requests that `blocks` checks, the newest: more would delay the worker

Reason = Literal["crashes", "overruns", "poison"]
Scope = RobotId | str | None
"""The robots that are refused: one robot, all robots of a tenant (its name), or all robots (None)."""


class _End(NamedTuple):
    """A sandbox of *robot* crashed at *at_s* (monotonic seconds), or was killed for an overrun."""

    at_s: float
    robot: RobotId
    is_crash: bool = True


class _Breaker(NamedTuple):
    """A circuit breaker that opened; times are monotonic seconds.

    ``overruns`` says that the last end of a sandbox before it opened was an overrun, not a crash.
    """

    opened_s: float
    until_s: float
    overruns: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """A refusal after crashes or overruns, as operators see it.

    Attributes:
        service: Name of the service.
        reason: "crashes" or "overruns" for an open circuit breaker, by what opened it; "poison" for requests.
        tenant: Tenant whose robots are refused; None means all tenants.
        robot: Name of the robot that is refused; None means all robots of the tenant.
        requests: Number of poison requests among the latest 1,000 requests that crashed; 0 for a circuit
            breaker.
        left_s: Seconds until the refusal ends; for several poison requests until the last of them ends.
    """

    service: str
    reason: Reason
    tenant: str | None
    robot: str | None
    requests: int
    left_s: float


class CircuitBreaker:
    """The crashes and overruns of the sandboxes of one worker, and the refusals that follow from them.

    All times are monotonic seconds.
    """

    def __init__(self, settings: ServiceSettings, *, poison_crashes: int = POISON_CRASHES) -> None:
        self._settings = settings
        self._poison_crashes = poison_crashes
        self._ends_of_request: OrderedDict[tuple[str, str], tuple[_End, ...]] = OrderedDict()
        """By name of the service and digest of the request; the request that crashed last is the last."""
        self._ends_of_service: dict[str, deque[_End]] = {}
        self._breakers: dict[tuple[str, Scope], _Breaker] = {}
        """By name of the service and refused robots; the circuit breaker that opened last is the last."""

    def refusal(self, robot: RobotId, service: str, digest: str, now: float) -> Poison | WorkerLost | None:
        """Return the error with which a request of *robot* to *service* is refused now; None if it may run.

        Returns:
            Poison if the request with this *digest* is a poison request for *robot*; otherwise WorkerLost,
            with the time until the next attempt, if a circuit breaker of *service* is open for *robot*.  None
            if neither is the case.
        """
        ends = self._ends_of_request.get((service, digest), ())
        if ends and any(self._poison_until(scope, ends) > now for scope in _scopes_of(robot)):
            return Poison(
                f"this request crashed the sandboxes that ran it, and is refused for up to {POISON_S:.0f} s",
                hint="send a different request, and read the reason of the crash in the server's log",
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
        """Note that a sandbox of *robot* crashed while it worked on the request with this *digest*."""
        end, key = _End(now, robot), (service, digest)
        self._count(service, end)
        before = self._ends_of_request.pop(key, ())
        self._ends_of_request[key] = (*before, end)[-_MAX_ENDS_OF_REQUEST:]
        while len(self._ends_of_request) > _MAX_REQUESTS or self._oldest_s() <= now - POISON_S:
            self._ends_of_request.popitem(last=False)

    def note_overrun(self, robot: RobotId, service: str, now: float) -> None:
        """Note that a sandbox of *robot* was killed because *service* had taken too long for a command."""
        self._count(service, _End(now, robot, is_crash=False))

    def open_services(self, now: float) -> list[str]:
        """Return the sorted names of the services that are refused now to all robots or to a whole tenant."""
        shared = (key for key, breaker in self._breakers.items() if breaker.until_s > now)
        return sorted({service for service, scope in shared if not isinstance(scope, RobotId)})

    def blocks(self, now: float) -> list[Block]:
        """Return all refusals that are in force at *now*.

        Refusals to several robots come before those to single ones, which are sorted by the robot's name.
        """
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
        """Lift the matching refusals, and remove the stored crashes and overruns of the matching robots.

        Args:
            now: Monotonic seconds.
            service: Lift only refusals of this service; None means every service.
            tenant: Lift only refusals to this tenant or to one of its robots; None means all refusals.
            robot: Lift only refusals to the robot of this name; None means all refusals that match *tenant*.

        Returns:
            The lifted refusals.
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
        """Store the *end* of a sandbox, and open the circuit breakers of *service* that have enough evidence.

        A circuit breaker opens again only if all ends that count for it came after it last opened.
        """
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
        """Open the circuit breaker of *service* for *scope* after the end *last*; remove closed ones."""
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
        """Return until when a request with the crashes *ends* is poison for *scope*; -inf if it is not."""
        return _evidence_since(scope, ends, self._poison_crashes) + POISON_S

    def _oldest_s(self) -> float:
        return next(iter(self._ends_of_request.values()))[-1].at_s


def _evidence_since(scope: Scope, ends: Sequence[_End], count: int) -> float:
    """Return since when there is sufficient evidence for a refusal to *scope*; -inf if there is none.

    The evidence is the smallest number of latest *ends* that contains *count* ends of robots in *scope*, and
    enough robots for *scope* (`_is_wide_enough`).  The result is the time in seconds of the first of these.
    Overruns count only if *scope* is one robot.
    """
    robots, ends_in_scope = set[RobotId](), 0
    for end in reversed(ends):
        if scope in _scopes_of(end.robot) and (end.is_crash or isinstance(scope, RobotId)):
            ends_in_scope += 1
            robots.add(end.robot)
            if ends_in_scope >= count and _is_wide_enough(scope, robots):
                return end.at_s
    return -math.inf


def _is_wide_enough(scope: Scope, robots: set[RobotId]) -> bool:
    """Return whether crashes at *robots* justify a refusal to all robots of *scope*."""
    if isinstance(scope, RobotId):
        return True
    if len(robots) < MIN_ROBOTS_OF_TENANT:
        return False
    of_the_largest_tenant = max(Counter(robot.tenant for robot in robots).values())
    return scope is not None or len(robots) - of_the_largest_tenant >= MIN_ROBOTS_OF_OTHER_TENANTS


def _scopes_of(robot: RobotId) -> tuple[Scope, ...]:
    """Return the scopes that contain *robot*: itself, its tenant, and all robots."""
    return robot, robot.tenant, None


def _tenant_and_name(scope: Scope) -> tuple[str | None, str | None]:
    """Return tenant and name of the robots of *scope*; None stands for all tenants, or all robots."""
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
        hint = "ask the operator to read the reasons of the crashes in the server's log"
    return WorkerLost(
        f"service {service!r} {how} and is refused for another {left_s:.0f} s",
        hint=hint,
        retry_after_ms=left_s * 1e3,
    )
