"""Decide how many robots a crowded server moves to others, so that all servers have about the same number.

`moves` is for a caller that knows the number of robots of every server, such as the local control plane;
`share` is the same rule for one server that knows only the totals, as on AWS.  No robot moves while the
numbers of all servers are within `MARGIN` of their mean, and no more robots move than necessary.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rse_pf.config.elasticity import MOVES_PER_S

__all__ = ["MARGIN", "MAX_PAUSE_S", "MoveOrder", "Totals", "moves", "pause_after_s", "plan_order", "share"]

# Robots move only while a server's number differs from the mean by more than this fraction.
MARGIN = 0.2
# Longest pause in seconds between two orders of a server whose robots do not move.
MAX_PAUSE_S = 600.0
# No robot moves while the number of all robots changes by more than this fraction between two periods.
_STEADY_FRACTION = 0.1


def moves(robots: Mapping[str, int], margin: float = MARGIN) -> dict[str, int]:
    """Return how many robots each crowded server has to move, by its name; empty if none has to.

    If the robots that move connect to the least crowded servers, every server then has a number within
    *margin* of the mean ``total / servers``, or a neighbouring whole number if none is within the margin.

    Args:
        robots: Number of robots of each server that takes part, by name; not negative.
        margin: Allowed deviation, as a fraction of the mean.
    """
    if len(robots) < 2:
        return {}
    total, servers = sum(robots.values()), len(robots)
    lowest, highest = _lowest_share(total, servers, margin), _highest_share(total, servers, margin)
    missing = sum(max(0, lowest - n) for n in robots.values())
    moving = {name: n - highest for name, n in robots.items() if n > highest}
    crowded = [(moving.get(name, 0) - n, name) for name, n in robots.items()]
    heapq.heapify(crowded)
    for _ in range(missing - sum(moving.values())):
        surplus, name = heapq.heappop(crowded)
        moving[name] = moving.get(name, 0) + 1
        heapq.heappush(crowded, (surplus + 1, name))
    return moving


def share(mine: int, total: int, servers: int, margin: float = MARGIN) -> int:
    """Return how many of its *mine* robots one server has to move, knowing only the totals.

    In the worst case all other servers but one are as crowded as this server, and the last one lacks the
    robots that they have in excess.  The margin of a server is therefore *margin* divided by ``servers - 1``.
    For two servers the result equals that of `moves`.

    Args:
        mine: Number of robots of this server.
        total: Number of robots of all servers, this server included.
        servers: Number of servers that take part, this server included.
        margin: Allowed deviation, as a fraction of the mean.
    """
    if servers < 2:
        return 0
    return max(0, mine - _highest_share(total, servers, margin / (servers - 1)))


def _highest_share(total: int, servers: int, margin: float) -> int:
    return max(math.ceil(total / servers), math.floor(total / servers * (1 + margin) + 1e-9))


def _lowest_share(total: int, servers: int, margin: float) -> int:
    return min(total // servers, math.ceil(total / servers * (1 - margin) - 1e-9))


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """The number of robots of all servers, and of servers, in the period that began at ``start_s`` (s)."""

    start_s: float
    robots: int
    servers: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MoveOrder:
    """An order to a server: ask *robots* of its robots to move, spread over *spread_s* seconds."""

    robots: int
    spread_s: float


def plan_order(mine: int, totals: Sequence[Totals]) -> MoveOrder | None:
    """Return the order that moves the surplus of a server with *mine* robots.

    None if the server is within its margin, or while the totals are missing or still change.  A server above
    its margin goes down to the mean, not only to the margin: some load balancers send a part of the robots
    back, and while all crowded servers go down to the mean, no other server gets more robots than it lacks.

    Args:
        mine: Number of robots of this server now.
        totals: Totals of whole periods, the newest first.
    """
    if len(totals) < 2 or not _is_steady(totals[0], totals[1]):
        return None
    total, servers = totals[0].robots, totals[0].servers
    if not share(mine, total, servers):
        return None
    robots = mine - math.ceil(total / servers)
    return MoveOrder(robots=robots, spread_s=round(robots / MOVES_PER_S, 3))


def pause_after_s(order: MoveOrder, *, within_s: float, failures: int) -> float:
    """Return how long, in seconds, a server gives no further order after *order*; at most `MAX_PAUSE_S`.

    Args:
        order: The server's last order.
        within_s: Time that a robot has for its move, in seconds.
        failures: Number of orders in a row before it that failed, because the server had no fewer robots at
            the next order: its robots cannot move, or the load balancer sends them back.  Each doubles the
            pause.
    """
    return min((order.spread_s + within_s) * 2.0**failures, MAX_PAUSE_S)


def _is_steady(newest: Totals, before: Totals) -> bool:
    changed = abs(newest.robots - before.robots)
    return newest.servers == before.servers and changed <= max(2.0, _STEADY_FRACTION * newest.robots)
