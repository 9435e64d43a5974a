"""Robots take turns, however many jobs one of them asks for, and each is served in the end."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rse_pf.backend.jobs.fair_queue import FairQueue, job_to_displace
from rse_pf.identity import RobotId

A, B, C = (RobotId("default", name) for name in "abc")


def order(line: FairQueue, count: int) -> str:
    """Serve *count* tickets, which begin with their robot's letter, and return whose they were."""
    served = ""
    for _ in range(count):
        ticket = line.first()
        assert isinstance(ticket, str)
        line.serve(ticket)
        served += ticket[0]
    return served


def test_a_robot_with_twenty_jobs_gets_every_other_turn_while_another_waits():
    line = FairQueue()
    for number in range(20):
        line.add(f"a{number}", A)
    for number in range(3):
        line.add(f"b{number}", B)

    assert order(line, 23) == "ab" * 3 + "a" * 17
    assert line.first() is None


def test_the_jobs_of_one_robot_run_in_the_order_of_arrival():
    line = FairQueue()
    for number in range(3):
        line.add(number, A)

    seen = []
    while (ticket := line.first()) is not None:
        seen.append(ticket)
        line.serve(ticket)

    assert seen == [0, 1, 2]


def test_a_new_robot_waits_for_one_turn_of_each_other_and_gets_no_extra_turns():
    line = FairQueue()
    for number in range(9):
        line.add(f"a{number}", A)
        line.add(f"b{number}", B)
    assert order(line, 5) == "ababa"

    for number in range(3):
        line.add(f"c{number}", C)

    assert order(line, 6) == "bacbac"


def test_removed_tickets_cost_their_robot_no_turn():
    line = FairQueue()
    for number in range(9):
        line.add(f"a{number}", A)
    for number in range(8):
        line.remove(f"a{number}")
    line.remove("a0")
    line.add("b0", B)
    line.add("b1", B)

    assert order(line, 3) == "abb"


def test_new_robots_that_keep_coming_do_not_starve_one_that_waits():
    line = FairQueue()
    line.add("a0", A)
    line.add("a1", A)
    served = ""
    for number in range(5):
        line.add(f"n{number}", RobotId("default", f"n{number}"))
        served += order(line, 1)

    assert served.count("a") == 2


@given(st.lists(st.sampled_from([A, B, C]), max_size=30))
def test_while_two_robots_wait_neither_gets_two_turns_more(comers: list[RobotId]):
    line = FairQueue()
    left = dict.fromkeys((A, B, C), 0)
    for number, who in enumerate(comers):
        line.add((who, number), who)
        left[who] += 1
    turns = dict.fromkeys(left, 0)
    while (ticket := line.first()) is not None:
        line.serve(ticket)
        who = ticket[0]  # type: ignore[index]
        turns[who] += 1
        left[who] -= 1
        waiting = [turns[each] for each in left if left[each]]
        assert not waiting or max(waiting) - min(waiting) <= 1


def test_the_newest_waiting_job_of_the_robot_with_most_jobs_is_displaced():
    jobs = [(A, False), (A, True), (B, True), (A, True), (B, True), (B, False)]

    assert job_to_displace(jobs, C) == 4
    assert job_to_displace([*jobs, (A, True)], C) == 6


def test_no_job_is_displaced_for_a_robot_with_as_many_or_one_less():
    assert job_to_displace([(A, True), (A, True)], A) is None
    assert job_to_displace([(A, True), (A, True), (B, True)], B) is None
    assert job_to_displace([(A, True)], B) is None
    assert job_to_displace([(A, False), (A, False), (A, False)], B) is None


def test_a_tenant_with_many_robots_gets_every_other_turn_while_another_tenant_waits():
    line = FairQueue()
    for number in range(6):
        line.add(f"m{number}", RobotId("many", f"robot-{number}"))
    for number in range(2):
        line.add(f"f{number}", RobotId("few", "robot-1"))

    assert order(line, 8) == "mfmfmmmm"
    assert line.first() is None


def test_a_full_queue_of_one_tenants_robots_gives_a_place_to_another_tenant():
    jobs = [(RobotId("many", f"robot-{number}"), True) for number in range(4)]

    assert job_to_displace(jobs, RobotId("few", "robot-1")) == 3
    assert job_to_displace(jobs, RobotId("many", "robot-9")) is None
    even = [*jobs[:2], *((RobotId("few", "robot-1"), True) for _ in range(2))]
    assert job_to_displace(even, RobotId("many", "robot-9")) is None
