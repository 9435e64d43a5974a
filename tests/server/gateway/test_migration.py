"""Robots are asked to move in time slots, each once, by the most loaded worker first."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.server.gateway.migration import Migration, plan
from tests.kit.fakes import FakeLoop


class Connection:
    def __init__(self, *, may_move: bool = True) -> None:
        self.may_move = may_move
        self.moving_until_s = float("-inf")
        self.asks: list[tuple[str, float, float]] = []

    def move(self, reason: str, within_ms: float, now: float) -> None:
        self.asks.append((reason, within_ms, now))
        self.moving_until_s = now + within_ms / 1e3


def migration(connections: list[Connection], loop: FakeLoop) -> Migration:
    return Migration(connections, loop=loop, now=loop.time, choose=lambda candidates: candidates[0])


loads = st.lists(st.integers(0, 60), min_size=1, max_size=4)


@given(loads, st.integers(0, 200), st.floats(0, 20), st.floats(0.5, 50), st.randoms(use_true_random=False))
def test_no_more_are_asked_in_any_second_than_allowed(robots_of, robots, spread_s, rate, random) -> None:
    delays = plan(robots_of, robots, spread_s=spread_s, moves_per_s=rate, random=random.random)

    times = sorted(itertools.chain(*delays))
    assert len(times) == min(robots, sum(robots_of))
    assert all(each == sorted(each) for each in delays)
    assert all(len(each) <= load for each, load in zip(delays, robots_of, strict=True))
    assert max((sum(t <= u < t + 1 for u in times) for t in times), default=0) <= rate + 2
    assert all(t <= max(spread_s, len(times) / rate) * (1 + 1e-12) for t in times)


def test_the_most_loaded_worker_asks_its_robots_first() -> None:
    delays = plan([10, 30], 20, spread_s=1.0, moves_per_s=1000.0, random=lambda: 0.0)

    assert [len(each) for each in delays] == [0, 20]


def test_a_robot_that_came_back_may_be_asked_again_once_its_time_is_over() -> None:
    loop, connections = FakeLoop(50.0), [Connection()]
    moves = migration(connections, loop)

    moves.begin([0.0, 0.9, 1.1], within_ms=1000.0)
    loop.advance(10.0)

    assert [now for _, _, now in connections[0].asks] == pytest.approx([50.0, 51.1])
