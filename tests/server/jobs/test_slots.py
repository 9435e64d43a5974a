"""The slots to run a job that all workers of a server share."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from rse_pf.identity import RobotId
from rse_pf.server.jobs.slots import JobSlots, make_slot_file

ONE, TWO = RobotId("default", "robot-1"), RobotId("default", "robot-2")


def stop(_: float) -> bool:
    """End the wait for a slot at once."""
    return False


@pytest.fixture
def file() -> Iterator[int]:
    """The slots of a server that runs one job at a time."""
    descriptor = make_slot_file()
    yield descriptor
    os.close(descriptor)


def other_worker_takes(file: int) -> bool:
    """Return whether another worker, which is killed then, took the slot."""
    pid = os.fork()
    if pid == 0:
        try:
            if JobSlots(file, 1).acquire(TWO, stop):
                os.kill(os.getpid(), signal.SIGKILL)
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL


def test_a_slot_that_one_worker_took_is_taken_for_the_others_until_it_is_released(file: int) -> None:
    slots = JobSlots(file, 1)

    assert slots.acquire(ONE, stop)
    assert not slots.acquire(ONE, stop)
    assert not other_worker_takes(file)
    slots.release()
    assert other_worker_takes(file)


def test_a_worker_that_is_killed_gives_its_slot_back(file: int) -> None:
    assert other_worker_takes(file)

    assert JobSlots(file, 1).acquire(ONE, stop)


def test_the_slot_goes_to_the_robot_whose_turn_it_is_although_another_one_asks(
    file: int,
) -> None:
    slots, late = JobSlots(file, 1), []
    slots.acquire(ONE, stop)

    def release_and_ask(_: float) -> bool:
        if not late:
            slots.release()
            late.append(slots.acquire(TWO, stop))
        return True

    assert slots.acquire(ONE, release_and_ask)
    assert late == [False]
