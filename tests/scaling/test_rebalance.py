"""Crowded servers move just enough robots, and then stop."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.scaling.rebalance import MoveOrder, Totals, pause_after_s, plan_order

fleets = st.lists(st.integers(0, 400), min_size=2, max_size=12).map(
    lambda counts: {f"server-{i + 1}": n for i, n in enumerate(counts)}
)


def settled(robots: dict[str, int], given_away: dict[str, int]) -> dict[str, int]:
    """Return where all are when those that move go, one by one, to the least crowded server."""
    after = {name: n - given_away.get(name, 0) for name, n in robots.items()}
    for _ in range(sum(given_away.values())):
        least = min(after, key=lambda name: after[name])
        after[least] += 1
    return after


def ordered(robots: dict[str, int]) -> dict[str, int]:
    """Return how many robots each server moves, while the totals are steady."""
    totals = [Totals(robots=sum(robots.values()), servers=len(robots))] * 2
    found = {name: plan_order(n, totals) for name, n in robots.items()}
    return {name: order.robots for name, order in found.items() if order is not None}


def test_a_new_server_gets_its_share_after_a_scale_out() -> None:
    assert ordered({"server-1": 50, "server-2": 50, "server-3": 0}) == {"server-1": 16, "server-2": 16}


@pytest.mark.parametrize("robots", [{}, {"server-1": 100}, {"server-1": 0, "server-2": 0}])
def test_without_robots_or_other_servers_nothing_moves(robots: dict[str, int]) -> None:
    assert ordered(robots) == {}


@pytest.mark.parametrize("robots", [{"a": 12, "b": 8}, {"a": 11, "b": 10, "c": 9}, {"a": 1, "b": 0}])
def test_nothing_moves_within_the_margin(robots: dict[str, int]) -> None:
    assert ordered(robots) == {}


@given(fleets, st.integers(0, 2**32))
def test_it_converges_when_each_robot_goes_to_the_better_of_two_random_servers(
    robots: dict[str, int], seed: int
) -> None:
    draw, now = random.Random(seed), dict(robots)
    for _ in range(200):
        handed = ordered(now)
        if not handed:
            break
        for name, n in handed.items():
            for _ in range(n):
                better = min(draw.choices(list(now), k=2), key=lambda each: now[each])
                if now[better] < now[name]:
                    now[name] -= 1
                    now[better] += 1

    assert ordered(now) == {}
    assert sum(now.values()) == sum(robots.values())


@given(fleets)
def test_orders_lead_to_even_and_never_past_it(robots: dict[str, int]) -> None:
    even = sum(robots.values()) / len(robots)

    orders = ordered(robots)
    after = settled(robots, orders)

    assert all(robots[name] - n >= even for name, n in orders.items()), "a server gave too much away"
    assert all(after[name] <= max(n, math.ceil(even)) for name, n in robots.items()), "one got too much"
    assert ordered(after) == {}, "robots move on and on"
    assert min(after.values()) >= math.floor(0.8 * even - (len(robots) - 1) - 1e-9), "one got too few"


def test_no_order_before_two_periods_agree() -> None:
    steady, grown, joined = (
        Totals(robots=robots, servers=servers) for robots, servers in ((120, 3), (140, 3), (120, 2))
    )

    assert plan_order(60, [steady]) is None
    assert plan_order(60, [steady, grown]) is None
    assert plan_order(60, [steady, joined]) is None
    assert plan_order(60, [steady, steady]) == MoveOrder(robots=20, spread_s=1.0)


def test_a_pause_doubles_with_each_order_that_moved_nobody_up_to_ten_minutes() -> None:
    order = MoveOrder(robots=20, spread_s=1.0)

    assert [pause_after_s(order, within_s=5.0, failures=each) for each in (0, 1, 2, 9)] == [6, 12, 24, 600]


@pytest.mark.parametrize("servers", [2, 3, 5, 8])
def test_an_empty_server_beside_full_ones_gets_at_least_four_fifths_of_the_mean(servers: int) -> None:
    robots = {"new": 0} | {f"server-{i}": 100 * servers for i in range(servers - 1)}

    after = settled(robots, ordered(robots))

    assert min(after.values()) >= 0.8 * sum(robots.values()) / servers - (servers - 1)
