"""Work of strangers runs oldest first, for a bounded time in each round of the event loop."""

from __future__ import annotations

import pytest

from rse_pf.server.scheduling.deferred_work import DeferredWork
from tests.kit.fakes import FakeLoop

BOUND_S = 0.0005


class DeferredRounds:
    """Deferred work on a loop of which a test runs single rounds; each step takes *step_s*."""

    def __init__(self, step_s: float) -> None:
        self.loop = FakeLoop(0.0)
        self.done: list[int] = []
        self.step_s = step_s
        self.work = DeferredWork(self.loop, clock=self.loop.time, bound_s=BOUND_S)  # type: ignore[arg-type]

    def step(self, number: int) -> None:
        self.loop.now += self.step_s
        self.done.append(number)

    def rounds(self) -> list[list[int]]:
        """Run until nothing waits; return what each round did, as a robot's frame between them sees it."""
        seen: list[list[int]] = []

        def frame() -> None:
            seen.append(self.done[sum(map(len, seen)) :])
            if len(self.work):
                self.loop.call_soon(frame)

        self.loop.call_soon(frame)
        self.loop.advance(0.0)
        return seen


def test_a_burst_is_divided_among_rounds_oldest_first() -> None:
    bench = DeferredRounds(BOUND_S / 4)
    for number in range(10):
        bench.work.add(bench.step, number)

    assert bench.rounds() == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]


def test_the_others_go_on_behind_a_step_that_fails() -> None:
    bench = DeferredRounds(0.0)

    def fail() -> None:
        raise OSError

    bench.work.add(fail)
    bench.work.add(bench.step, 1)

    with pytest.raises(OSError):
        bench.loop.advance(0.0)
    bench.loop.advance(0.0)

    assert bench.done == [1]
