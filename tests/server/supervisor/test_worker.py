"""A worker takes new sockets for a bounded time in each round of its event loop, whatever they cost."""

from __future__ import annotations

from itertools import count

from rse_pf.server.supervisor.worker import repeat_for

STEP_S, BOUND_S = 1e-3, 5e-4


def test_a_step_longer_than_the_bound_is_done_once() -> None:
    times, steps = count(0.0, STEP_S), count(1)

    repeat_for(BOUND_S, lambda: next(steps) > 0, lambda: next(times))

    assert next(steps) == 2


def test_cheap_steps_are_done_together_until_the_bound() -> None:
    times, steps = count(0.0, BOUND_S / 8), count(1)

    repeat_for(BOUND_S, lambda: next(steps) > 0, lambda: next(times))

    assert next(steps) == 9


def test_nothing_more_is_done_where_nothing_waits() -> None:
    steps = count(1)

    repeat_for(BOUND_S, lambda: next(steps) < 3, lambda: 0.0)

    assert next(steps) == 4
