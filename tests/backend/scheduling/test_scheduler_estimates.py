"""How the scheduler measures its own speed, and how long it expects a command to wait."""

from __future__ import annotations

import pytest
from backend.scheduling.admitted import AdmittedScheduler, measure_turns, queued


def test_a_process_that_did_not_run_for_a_moment_refuses_nobody_who_has_time():
    """A second without the processor in the middle of a round of 50 robots, who have five seconds each."""
    scheduler = AdmittedScheduler()
    now = 0.0

    def serve(count: int) -> None:
        nonlocal now
        for _ in range(count):
            started, refusals = scheduler.start(now)
            assert started is not None
            assert refusals == []
            now += 0.002
            scheduler.done(started, now)

    for robot in range(50):
        assert scheduler.submit(queued(f"r{robot}", at=now, within=5.0), now) == []
    serve(25)
    now += 1.0
    serve(1)
    for robot in range(26):
        assert scheduler.submit(queued(f"r{robot}", at=now, within=5.0), now) == []
    serve(50)


@pytest.mark.parametrize("service_s", [0.05, 0.5])
def test_a_service_that_became_slow_is_believed_within_a_few_commands(service_s):
    scheduler = AdmittedScheduler()
    now, turns = 0.0, []
    for number in range(40):
        for robot in ("a", "b"):
            scheduler.submit(queued(f"{robot}{number}", at=now, within=1e3), now)
        while (started := scheduler.start(now)[0]) is not None:
            now += 0.002 if number < 10 else service_s
            scheduler.done(started, now)
            turns.append(scheduler.turn_s)

    assert turns[18] < 0.01
    assert turns[60] > 0.5 * service_s


def test_a_robot_with_many_waiting_is_told_the_whole_queue_at_most():
    """Half of the robots came from a server that died, with six commands each; the others have one."""
    scheduler = AdmittedScheduler()
    measure_turns(scheduler, 0.01, 0.0)
    for robot in range(50):
        for number in range(6 if robot < 25 else 1):
            assert scheduler.submit(queued(f"r{robot}", number, within=60.0), 0.0) == []

    assert scheduler.waiting == 175
    assert scheduler.backlog(queued("r0"))[1] == pytest.approx(1.76)
    assert scheduler.backlog(queued("r30"))[1] == pytest.approx(1.0)
    assert scheduler.backlog(queued("new"))[1] == pytest.approx(0.5)
