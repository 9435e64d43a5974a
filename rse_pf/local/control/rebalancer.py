"""Decide when robots of crowded servers move: within half a minute after servers or robots came back.

`rse_pf.scaling.rebalance.moves` says how many.  No robot moves while the numbers still change,
and a request is not repeated before its robots are counted on their new server.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from rse_pf.config.elasticity import MOVES_PER_S
from rse_pf.scaling.rebalance import moves

__all__ = ["MoveRequest", "Rebalancer"]

# Time for which the spread is watched after a change, in seconds.
_WATCH_S = 30.0
# Time after a request until its robots are counted on their new server, in seconds.
_SETTLE_S = 1.5
# No robot moves while more than this share of all robots changes from one sample to the next.
_STEADY_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class MoveRequest:
    """Ask *server* to let *robots* of its robots move, spread over *spread_s*."""

    server: str
    robots: int
    spread_s: float


class Rebalancer:
    """Keeps the time until which the spread of the robots is watched."""

    def __init__(self) -> None:
        self._until_s = -math.inf
        self._quiet_until_s = -math.inf
        self._before: Mapping[str, int] = {}

    def watch(self, now_s: float) -> None:
        """Watch the spread from now on, for half a minute."""
        self._until_s = now_s + _WATCH_S

    def requests(self, robots: Mapping[str, int], now_s: float) -> tuple[MoveRequest, ...]:
        """Return the requests to make now; *robots* has the robots of each healthy server, by name."""
        before, self._before = self._before, dict(robots)
        if not self._quiet_until_s <= now_s <= self._until_s or not _steady(before, robots):
            return ()
        move_requests = tuple(
            MoveRequest(server=name, robots=count, spread_s=round(count / MOVES_PER_S, 3))
            for name, count in moves(robots).items()
            if count > 0
        )
        if move_requests:
            self._quiet_until_s = now_s + max(order.spread_s for order in move_requests) + _SETTLE_S
        return move_requests


def _steady(before: Mapping[str, int], now: Mapping[str, int]) -> bool:
    """Return whether the same servers carry about the same robots as a sample ago."""
    changed = sum(abs(count - before.get(name, 0)) for name, count in now.items())
    return before.keys() == now.keys() and changed <= max(2.0, _STEADY_SHARE * sum(now.values()))
