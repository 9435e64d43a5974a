"""Decide when robots of crowded servers move to others: within 30 s after a server or the balancer came back.

`rse_pf.scaling.rebalance.moves` computes how many robots each server moves.  No robot moves while the numbers
of robots still change, and a server gets no further request before the robots that moved are counted on their
new server.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from rse_pf.config.elasticity import MOVES_PER_S
from rse_pf.scaling.rebalance import moves

__all__ = ["MoveRequest", "Rebalancer"]

# Time after a change for which uneven numbers of robots lead to moves, in seconds.
_WATCH_S = 30.0
# Time after the last robot was asked to move until it is counted on its new server, in seconds; no request
# before.
_SETTLE_S = 1.5
# No robot moves while the servers' numbers of robots change by more than this share of all robots from one
# sample to the next.
_STEADY_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class MoveRequest:
    """A request to *server*: ask *robots* of its robots to move, spread over *spread_s* seconds."""

    server: str
    robots: int
    spread_s: float


class Rebalancer:
    """Decides which servers move robots; keeps the time until which robots may move, and the last sample."""

    def __init__(self) -> None:
        self._until_s = -math.inf
        self._quiet_until_s = -math.inf
        self._before: Mapping[str, int] = {}

    def watch(self, now_s: float) -> None:
        """Allow moves for 30 s from *now_s* (monotonic)."""
        self._until_s = now_s + _WATCH_S

    def requests(self, robots: Mapping[str, int], now_s: float) -> tuple[MoveRequest, ...]:
        """Return the requests to send now; none outside of the time that `watch` began.

        Args:
            robots: Number of robots of each healthy server, by name, in the newest sample.
            now_s: Time of that sample, monotonic.
        """
        before, self._before = self._before, dict(robots)
        if not self._quiet_until_s <= now_s <= self._until_s or not _is_steady(before, robots):
            return ()
        move_requests = tuple(
            MoveRequest(server=name, robots=count, spread_s=round(count / MOVES_PER_S, 3))
            for name, count in moves(robots).items()
            if count > 0
        )
        if move_requests:
            self._quiet_until_s = now_s + max(order.spread_s for order in move_requests) + _SETTLE_S
        return move_requests


def _is_steady(before: Mapping[str, int], now: Mapping[str, int]) -> bool:
    """Return whether *now* has the same servers as *before*, the sample before, and about the same numbers.

    A change by 2 robots in total is always allowed.
    """
    changed = sum(abs(count - before.get(name, 0)) for name, count in now.items())
    return before.keys() == now.keys() and changed <= max(2.0, _STEADY_SHARE * sum(now.values()))
