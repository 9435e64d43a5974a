"""Crowded servers move just enough robots, and then stop."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.scaling.rebalance import MoveOrder, Totals, moves, pause_after_s, plan_order, share

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


def even_range(robots: dict[str, int], percent: float) -> tuple[int, int]:
    even = sum(robots.values()) / len(robots)
    fits = [n for n in range(max(robots.values()) + 2) if abs(n - even) <= even * percent / 100 + 1e-9]
    return min([math.floor(even), *fits]), max([math.ceil(even), *fits])


def test_a_new_server_gets_its_share_after_a_scale_out() -> None:
    robots = {"server-1": 50, "server-2": 50, "server-3": 0}

    handed = moves(robots)

    assert handed == {"server-1": 14, "server-2": 13} or handed == {"server-1": 13, "server-2": 14}


@pytest.mark.parametrize("robots", [{}, {"server-1": 100}, {"server-1": 0, "server-2": 0}])
def test_without_robots_or_other_servers_nothing_moves(robots: dict[str, int]) -> None:
    assert moves(robots) == {}


@given(fleets, st.floats(0, 100))
def test_all_end_within_the_margin_in_one_round_and_then_nothing_moves(
    robots: dict[str, int], percent: float
) -> None:
    low, high = even_range(robots, percent)

    handed = moves(robots, percent / 100)
    after = settled(robots, handed)

    assert sum(after.values()) == sum(robots.values())
    assert all(0 < n <= robots[name] for name, n in handed.items())
    assert low <= min(after.values())
    assert max(after.values()) <= high
    assert moves(after, percent / 100) == {}


@given(fleets, st.integers(0, 2**32))
def test_it_converges_when_each_robot_goes_to_the_better_of_two_random_servers(
    robots: dict[str, int], seed: int
) -> None:
    draw, now = random.Random(seed), dict(robots)
    for _ in range(200):
        handed = moves(now)
        if not handed:
            break
        for name, n in handed.items():
            for _ in range(n):
                better = min(draw.choices(list(now), k=2), key=lambda each: now[each])
                if now[better] < now[name]:
                    now[name] -= 1
                    now[better] += 1

    assert moves(now) == {}
    assert sum(now.values()) == sum(robots.values())


@given(fleets)
def test_servers_that_know_only_the_sums_fill_up_an_empty_one_and_then_stop(robots: dict[str, int]) -> None:
    total, servers = sum(robots.values()), len(robots)
    handed = {name: share(n, total, servers) for name, n in robots.items()}

    after = settled(robots, handed)

    assert all(share(n, total, servers) == 0 for n in after.values())
    even = total / servers
    assert min(after.values()) >= math.floor(even - 0.2 * even - (servers - 1) - 1e-9)


def ordered(robots: dict[str, int]) -> dict[str, int]:
    """Return what each server orders that knows its own robots and steady sums."""
    sums = [Totals(start_s=at, robots=sum(robots.values()), servers=len(robots)) for at in (10.0, 0.0)]
    found = {name: plan_order(n, sums) for name, n in robots.items()}
    return {name: order.robots for name, order in found.items() if order is not None}


@given(fleets)
def test_orders_of_servers_that_know_only_the_sums_lead_to_even_and_never_past_it(
    robots: dict[str, int],
) -> None:
    even = sum(robots.values()) / len(robots)

    orders = ordered(robots)
    after = settled(robots, orders)

    assert all(robots[name] - n >= even for name, n in orders.items()), "a server gave too much away"
    assert all(after[name] <= max(n, math.ceil(even)) for name, n in robots.items()), "one got too much"
    assert ordered(after) == {}, "robots move on and on"


def test_no_order_before_two_periods_agree() -> None:
    steady, grown, joined = (
        Totals(start_s=10.0, robots=robots, servers=servers)
        for robots, servers in ((120, 3), (140, 3), (120, 2))
    )

    assert plan_order(60, [steady]) is None
    assert plan_order(60, [steady, grown]) is None
    assert plan_order(60, [steady, joined]) is None
    assert plan_order(60, [steady, steady]) == MoveOrder(robots=20, spread_s=1.0)


def test_a_pause_doubles_with_each_order_that_moved_nobody_up_to_ten_minutes() -> None:
    order = MoveOrder(robots=20, spread_s=1.0)

    assert [pause_after_s(order, within_s=5.0, failures=each) for each in (0, 1, 2, 9)] == [6, 12, 24, 600]


def test_a_single_server_moves_no_robots() -> None:
    assert share(100, 100, 1) == 0


@pytest.mark.parametrize("servers", [2, 3, 5, 8])
def test_an_empty_server_beside_full_ones_gets_four_fifths_of_the_average_under_both_rules(
    servers: int,
) -> None:
    robots = {"new": 0} | {f"server-{i}": 100 * servers for i in range(servers - 1)}
    total = sum(robots.values())

    after = settled(robots, {name: share(n, total, servers) for name, n in robots.items()})

    assert min(after.values()) >= 0.8 * total / servers - (servers - 1)
