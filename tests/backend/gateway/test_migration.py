"""Robots are asked to move in time slots, each once, by the most loaded worker first."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.backend.gateway.migration import Migration, plan


class Timers:
    """Fire in order of time."""

    def __init__(self) -> None:
        self.now = 50.0
        self.waiting: list[tuple[float, Callable[..., object], tuple[object, ...]]] = []

    def call_later(self, delay: float, callback: Callable[..., object], *args: object) -> object:
        self.waiting.append((self.now + delay, callback, args))
        return self

    def fire_all(self) -> None:
        due, self.waiting = sorted(self.waiting, key=lambda each: each[0]), []
        for self.now, callback, args in due:
            callback(*args)


class Link:
    def __init__(self, *, may_move: bool = True) -> None:
        self.may_move = may_move
        self.asks: list[tuple[str, float, float]] = []

    def move(self, reason: str, within_ms: float, now: float) -> None:
        self.asks.append((reason, within_ms, now))


def hand_over(links: list[Link], timers: Timers) -> Migration:
    return Migration(links, timers=timers, now=lambda: timers.now, choose=lambda candidates: candidates[0])


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


def test_the_asks_fill_the_time_they_were_given() -> None:
    (delays,) = plan([100], 10, spread_s=5.0, moves_per_s=1000.0, random=lambda: 0.5)

    assert delays == pytest.approx([0.25 + 0.5 * i for i in range(10)])


def test_the_most_loaded_worker_asks_first() -> None:
    delays = plan([10, 30], 20, spread_s=1.0, moves_per_s=1000.0, random=lambda: 0.0)

    assert [len(each) for each in delays] == [0, 20]


def test_each_robot_is_asked_once() -> None:
    timers, links = Timers(), [Link() for _ in range(5)]
    giving = hand_over(links, timers)

    giving.begin([0.1, 0.2, 0.3, 0.4], within_ms=5000.0)
    timers.fire_all()

    assert [len(link.asks) for link in links] == [1, 1, 1, 1, 0]
    assert links[0].asks[0] == ("rebalance", 5000.0, pytest.approx(50.1))
    assert giving.asked == 4


def test_a_robot_that_came_back_may_be_asked_again_after_its_time() -> None:
    timers, links = Timers(), [Link()]
    giving = hand_over(links, timers)

    giving.begin([0.0, 0.9, 1.1], within_ms=1000.0)
    timers.fire_all()

    assert [now for _, _, now in links[0].asks] == pytest.approx([50.0, 51.1])


def test_a_robot_without_hello_is_not_asked_and_a_robot_that_left_is_forgotten() -> None:
    timers, links = Timers(), [Link(may_move=False), Link()]
    giving = hand_over(links, timers)

    giving.begin([0.0], within_ms=1000.0)
    timers.fire_all()
    assert [len(link.asks) for link in links] == [0, 1]

    links.pop()
    giving.begin([0.0], within_ms=1000.0)
    timers.fire_all()
    assert giving.asked == 1
