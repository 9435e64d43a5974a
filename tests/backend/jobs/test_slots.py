"""The slots to run a job that all workers of a server share."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from rse_pf.backend.jobs.slots import JobSlots, make_pipe
from rse_pf.identity import RobotId

ONE, TWO = RobotId("default", "robot-1"), RobotId("default", "robot-2")


def stop(_: float) -> bool:
    """End the wait for a slot at once."""
    return False


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """The pipe of a server that runs one job at a time."""
    ends = make_pipe(1)
    yield ends
    for end in ends:
        os.close(end)


def test_a_slot_that_one_worker_took_is_taken_for_the_others_until_it_is_released(
    pipe: tuple[int, int],
) -> None:
    one, other = JobSlots(pipe), JobSlots(pipe)

    assert one.acquire(ONE, stop)
    assert not other.acquire(TWO, stop)
    one.release()
    assert other.acquire(TWO, stop)


def test_a_robot_that_gave_up_waiting_leaves_its_turn_to_the_next(pipe: tuple[int, int]) -> None:
    slots = JobSlots(pipe)
    slots.acquire(ONE, stop)
    assert not slots.acquire(ONE, stop)
    slots.release()

    assert slots.acquire(TWO, stop)


def test_the_slot_goes_to_the_robot_whose_turn_it_is_although_another_one_asks(
    pipe: tuple[int, int],
) -> None:
    slots, late = JobSlots(pipe), []
    slots.acquire(ONE, stop)

    def release_and_ask(_: float) -> bool:
        if not late:
            slots.release()
            late.append(slots.acquire(TWO, stop))
        return True

    assert slots.acquire(ONE, release_and_ask)
    assert late == [False]
