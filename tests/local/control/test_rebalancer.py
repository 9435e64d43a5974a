"""Crowded servers are asked while it is worth it, and not again before their robots have moved."""

from __future__ import annotations

from rse_pf.local.control.rebalancer import Rebalancer

UNEVEN = {"server-1": 50, "server-2": 50, "server-3": 0}


def watching(robots: dict[str, int], since_s: float = 100.0) -> Rebalancer:
    """Return one that watches since *since_s*, and has seen *robots* just before."""
    rebalancer = Rebalancer()
    rebalancer.plan_orders(robots, since_s - 1.0)
    rebalancer.watch(since_s)
    return rebalancer


def test_crowded_servers_are_asked_at_the_rate_that_is_allowed() -> None:
    rebalancer = watching(UNEVEN)

    orders = rebalancer.plan_orders(UNEVEN, 100.5)

    assert orders.keys() == {"server-1", "server-2"}
    assert all(order.robots > 0 and order.spread_s == order.robots / 20.0 for order in orders.values())


def test_an_order_is_not_repeated_before_its_robots_had_time_to_move_and_then_it_is() -> None:
    rebalancer = watching(UNEVEN)
    longest_s = max(order.spread_s for order in rebalancer.plan_orders(UNEVEN, 100.0).values())

    assert rebalancer.plan_orders(UNEVEN, 100.0 + longest_s) == {}
    assert rebalancer.plan_orders(UNEVEN, 100.0 + longest_s + 2.0) != {}


def test_half_a_minute_after_a_change_no_robot_is_moved() -> None:
    assert watching(UNEVEN).plan_orders(UNEVEN, 131.0) == {}
