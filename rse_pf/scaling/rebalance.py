"""Decide how many robots a crowded server hands over, so that all servers carry about the same.

`moves` knows every server, as the local control plane does; `share` is the same rule from the view of one
server that knows only the sums, as in AWS.  Promises no clock and no randomness, that nothing moves while
all are within the margin of even, and never more robots than that takes.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Mapping

__all__ = ["MARGIN", "moves", "share"]

MARGIN = 0.2
"""Crowded servers hand robots over until all are within this share of even."""


def moves(robots: Mapping[str, int], margin: float = MARGIN) -> dict[str, int]:
    """Return how many robots each crowded server hands over; empty if none has to.

    Even is ``total / servers``.  When the robots that move land on the least crowded servers, all end within
    *margin* of even, or at the whole numbers around even where the margin holds none.

    Args:
        robots: Robots of each server that may take and give, by name; none may be negative.
        margin: A share of even.
    """
    if len(robots) < 2:
        return {}
    total, servers = sum(robots.values()), len(robots)
    lowest, highest = _lowest(total, servers, margin), _highest(total, servers, margin)
    missing = sum(max(0, lowest - n) for n in robots.values())
    given = {name: n - highest for name, n in robots.items() if n > highest}
    crowded = [(given.get(name, 0) - n, name) for name, n in robots.items()]
    heapq.heapify(crowded)
    for _ in range(missing - sum(given.values())):
        left, name = heapq.heappop(crowded)
        given[name] = given.get(name, 0) + 1
        heapq.heappush(crowded, (left + 1, name))
    return given


def share(mine: int, total: int, servers: int, margin: float = MARGIN) -> int:
    """Return how many of its *mine* robots one server hands over, knowing only the sums.

    It must assume that every other server but one is as crowded as itself, and that this one misses all that
    the others have too much: so the margin is shared among them.  With two servers it is the rule of `moves`.

    Args:
        mine: Robots of this server.
        total: Robots of all servers, this one included.
        servers: How many take and give, this one included.
        margin: A share of even.
    """
    if servers < 2:
        return 0
    return max(0, mine - _highest(total, servers, margin / (servers - 1)))


def _highest(total: int, servers: int, margin: float) -> int:
    return max(math.ceil(total / servers), math.floor(total / servers * (1 + margin) + 1e-9))


def _lowest(total: int, servers: int, margin: float) -> int:
    return min(total // servers, math.ceil(total / servers * (1 - margin) - 1e-9))
