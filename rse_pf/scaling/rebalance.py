"""Decide how many robots a crowded server moves to others, so that all servers have about the same number.

The rule needs only the number of robots of one server and the totals of all servers: on AWS each server
applies it to itself, on one machine the control plane applies it to each server.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rse_pf.config.elasticity import MOVES_PER_S

__all__ = ["MAX_PAUSE_S", "MoveOrder", "Totals", "pause_after_s", "plan_order"]

# Largest difference of a server's robots from the mean, as a fraction of the mean, at which no robot moves.
_MARGIN = 0.2
# Longest pause in seconds between two orders of a server whose robots do not move.
MAX_PAUSE_S = 600.0
# No robot moves while the number of all robots changes by more than this fraction between two samples.
_STEADY_FRACTION = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Totals:
    """The number of robots of all servers, and the number of servers, in one sample."""

    robots: int
    servers: int


@dataclass(frozen=True, slots=True, kw_only=True)
class MoveOrder:
    """An order to a server: ask *robots* of its robots to move, spread over *spread_s* seconds."""

    robots: int
    spread_s: float


def plan_order(mine: int, totals: Sequence[Totals]) -> MoveOrder | None:
    """Return the order that moves the surplus of a server with *mine* robots; None without an order.

    1. Nothing moves while the totals are missing or still change, or if there is one server.
    2. A server is crowded above ``mean * (1 + 0.2 / (servers - 1))``, rounded down, and above the mean,
       rounded up.  The margin is divided because in the worst case all servers but one are as crowded as this
       one, and the last one lacks the robots that they have in excess.
    3. A crowded server goes down to the mean, not only to the margin: some load balancers send a part of the
       robots back, and while all crowded servers go down to the mean, no other one gets more than it lacks.

    Args:
        mine: Number of robots of this server now.
        totals: Totals of all servers in the newest samples, the newest first.
    """
    if len(totals) < 2 or totals[0].servers < 2 or not _is_steady(totals[0], totals[1]):
        return None
    mean, margin = totals[0].robots / totals[0].servers, _MARGIN / (totals[0].servers - 1)
    if mine <= max(math.ceil(mean), math.floor(mean * (1 + margin) + 1e-9)):
        return None
    robots = mine - math.ceil(mean)
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
