"""The search for the most robots ends close below what a server carries, and within its time."""

from __future__ import annotations

from itertools import count

import pytest

from benchmarks.server.capacity import MOST, PRECISION, SEARCH_S, CapacityStep, search


def step_of(robots: int, is_carried: bool) -> CapacityStep:
    return CapacityStep(
        robots=robots, ok=1, failed=0 if is_carried else 1, lost=0, unsent=0, p50_ms=1.0, p99_ms=2.0,
        late_p99_ms=0.1, codes={}, generator_cores=0.1,
    )  # fmt: skip


def most(steps: list[CapacityStep]) -> int:
    return max((each.robots for each in steps if each.is_carried), default=0)


@pytest.mark.parametrize("capacity", [90, 300, 1000, 3333])
def test_finds_the_most_robots_that_are_carried(capacity: int) -> None:
    steps = search(lambda robots: step_of(robots, robots <= capacity), lambda: 0.0)

    assert capacity / PRECISION <= most(steps) <= capacity


def test_a_step_that_failed_once_is_tried_again() -> None:
    tries = count()

    steps = search(lambda robots: step_of(robots, robots <= 1000 and next(tries) > 0), lambda: 0.0)

    assert [each.robots for each in steps[:2]] == [250, 250]
    assert most(steps) >= 1000 / PRECISION


def test_begins_no_step_after_its_time() -> None:
    times = count(0.0, SEARCH_S)

    assert len(search(lambda robots: step_of(robots, True), lambda: next(times))) <= 2


def test_does_not_search_beyond_its_bound() -> None:
    assert most(search(lambda robots: step_of(robots, True), lambda: 0.0)) <= MOST
