"""Decide when robots of crowded servers move to others: within 30 s after a server or the balancer came back.

`rse_pf.scaling.rebalance.plan_order` computes how many robots each server moves.  A server gets no further
order before the robots that moved are counted on their new server.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from rse_pf.scaling.rebalance import MoveOrder, Totals, plan_order

__all__ = ["Rebalancer"]

# Time after a change for which uneven numbers of robots lead to moves, in seconds.
_WATCH_S = 30.0
# Time after the last robot was asked to move until it is counted on its new server, in seconds.
_SETTLE_S = 1.5


class Rebalancer:
    """Decides which servers move robots; keeps the time until which robots may move, and the last totals."""

    def __init__(self) -> None:
        self._until_s = -math.inf
        self._quiet_until_s = -math.inf
        self._totals: list[Totals] = []

    def watch(self, now_s: float) -> None:
        """Allow moves for 30 s from *now_s* (monotonic)."""
        self._until_s = now_s + _WATCH_S

    def plan_orders(self, robots: Mapping[str, int], now_s: float) -> dict[str, MoveOrder]:
        """Return the orders to send now, by server; none outside of the time that `watch` began.

        Args:
            robots: Number of robots of each healthy server, by name, in the newest sample.
            now_s: Time of that sample, monotonic.
        """
        self._totals = [Totals(robots=sum(robots.values()), servers=len(robots)), *self._totals[:1]]
        if not self._quiet_until_s <= now_s <= self._until_s:
            return {}
        planned = {name: plan_order(count, self._totals) for name, count in robots.items()}
        orders = {name: order for name, order in planned.items() if order is not None}
        if orders:
            self._quiet_until_s = now_s + max(order.spread_s for order in orders.values()) + _SETTLE_S
        return orders
