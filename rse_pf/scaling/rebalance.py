"""Decide how many robots a crowded server moves to others, so that all servers have about the same number.

`moves` is for a caller that has the numbers of every server, such as the local control plane; `share` is the
same rule for one server that has only the totals, as on AWS.  No robot moves while all servers are within the
margin, and no more robots move than necessary.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rse_pf.config.elasticity import MOVES_PER_S

__all__ = ["MARGIN", "MAX_PAUSE_S", "MoveOrder", "Totals", "moves", "pause_after_s", "plan_order", "share"]

# Robots move until all servers are within this share of the mean: moving more gains little.
MARGIN = 0.2
# Longest pause of a server whose robots do not move, in seconds.
MAX_PAUSE_S = 600.0
# No robot moves while their total changes by more than this share from one period to the next.
_STEADY_SHARE = 0.1


def moves(robots: Mapping[str, int], margin: float = MARGIN) -> dict[str, int]:
    """Return how many robots each crowded server has to move; empty if none has to.

    Even is ``total / servers``.  When the robots that move land on the least crowded servers, all end within
    *margin* of even, or at the whole numbers around even where the margin holds none.

    Args:
        robots: Number of robots of each server that takes part, by name; not negative.
        margin: A share of even.
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

    It must assume that all other servers but one are as crowded as itself, and that this one lacks what the
    others have in excess; the margin is therefore divided among them.  For two servers this equals `moves`.

    Args:
        mine: Number of robots of this server.
        total: Robots of all servers, this one included.
        servers: Number of servers that take part, this one included.
        margin: A share of even.
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
    """Robots of all servers, and the number of servers, in the period that began at ``start_s``."""

    start_s: float
    robots: int
    servers: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MoveOrder:
    """Let *robots* robots move, spread over *spread_s*."""

    robots: int
    spread_s: float


def plan_order(mine: int, totals: Sequence[Totals]) -> MoveOrder | None:
    """Return what a server with *mine* robots orders; None if nothing, or if the sums still change.

    A server that is above its share goes down to even, not to the border of the margin: some load balancers
    send a part of the robots back, and no server can get more than it lacks while all go down to even.

    Args:
        mine: Robots of this server now.
        totals: Of whole periods, the newest first.
    """
    if len(totals) < 2 or not _is_steady(totals[0], totals[1]):
        return None
    total, servers = totals[0].robots, totals[0].servers
    if not share(mine, total, servers):
        return None
    robots = mine - math.ceil(total / servers)
    return MoveOrder(robots=robots, spread_s=round(robots / MOVES_PER_S, 3))


def pause_after_s(order: MoveOrder, *, within_s: float, failures: int) -> float:
    """Return how long a server asks nobody after *order*.

    Args:
        order: The last one.
        within_s: Time that a robot gets to move.
        failures: Orders before it, in a row, after which the server had no robot less: such robots cannot
            move, or the load balancer sends them back, and the pause doubles.
    """
    return min((order.spread_s + within_s) * 2.0**failures, MAX_PAUSE_S)


def _is_steady(newest: Totals, before: Totals) -> bool:
    changed = abs(newest.robots - before.robots)
    return newest.servers == before.servers and changed <= max(2.0, _STEADY_SHARE * newest.robots)
