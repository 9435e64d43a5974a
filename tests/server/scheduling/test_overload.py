"""What a server refuses beyond its capacity, and what robots that obey, or do not, get of it."""

from __future__ import annotations

import heapq
import random
from collections import Counter
from dataclasses import dataclass

import pytest

from rse_pf.identity import RobotId
from rse_pf.server.scheduling.overload import PAUSE_S, OverloadControl
from rse_pf.server.scheduling.scheduler import Scheduler
from tests.kit.admitted_commands import queued

WORK_S, DEADLINE_S, SECONDS = 0.005, 0.25, 12.0
REFUSAL_S = WORK_S / 2
CAPACITY_PER_S = 1 / WORK_S


@pytest.mark.parametrize(
    ("wait_s", "allowed_s", "refused_percent"),
    [
        pytest.param(0.05, 0.25, 0, id="a short wait"),
        pytest.param(0.0875, 0.25, 50, id="between the bounds"),
        pytest.param(0.2, 0.25, 100, id="beyond half of the time"),
        pytest.param(2.0, 10.0, 0, id="a short wait of a patient command"),
        pytest.param(5.25, 10.0, 50, id="a patient command between the bounds"),
        pytest.param(8.5, 10.0, 100, id="all but the reserve of a patient command"),
        pytest.param(8.5, 0.0, 0, id="no time at all: the command expires instead"),
    ],
)
def test_the_refused_share_grows_with_the_expected_wait(
    wait_s: float, allowed_s: float, refused_percent: int
):
    rule, pauses_s = OverloadControl(), []
    for _ in range(1000):
        pauses_s.append(rule.pause_s("t", wait_s, allowed_s))
        if not pauses_s[-1]:
            rule.note_accepted("t", 0.0)

    refused = [pause_s for pause_s in pauses_s if pause_s]
    assert len(refused) == pytest.approx(10 * refused_percent, abs=10)
    if refused:
        assert 0.5 * PAUSE_S <= min(refused) < 0.55 * PAUSE_S
        assert 1.45 * PAUSE_S < max(refused) <= 1.5 * PAUSE_S


def sometimes_refused(rule: OverloadControl, tenant: str) -> bool:
    """Return whether one of a few commands of *tenant* would be refused."""
    for _ in range(8):
        if rule.pause_s(tenant, 9.0, DEADLINE_S):
            return True
        rule._advance()
    return False


def test_nothing_is_refused_of_a_tenant_that_got_less_than_the_others_of_late():
    rule = OverloadControl()
    for number in range(100):
        rule.note_accepted("much", 0.0)
        if number % 4 == 0:
            rule.note_accepted("little", 0.0)

    assert rule.pause_s("little", 9.0, DEADLINE_S) == 0.0
    assert rule.pause_s("new", 9.0, DEADLINE_S) == 0.0
    assert sometimes_refused(rule, "much")
    for second in range(1, 9):
        rule.note_accepted("little", float(second))
    assert sometimes_refused(rule, "little"), "what was long ago is forgotten"


@dataclass(frozen=True, order=True)
class Fleet:
    """Robots of one tenant, which send *per_s* commands a second in all."""

    tenant: str
    robots: int
    per_s: float
    obeys: bool = True


def drive(*fleets: Fleet) -> tuple[Counter[str], Counter[str], Counter[RobotId]]:
    """Return how many commands of each tenant were served in time, and refused, and those of each robot.

    A robot that does not obey is read one command at a time once it was refused.
    """
    scheduler, chance = Scheduler(), random.Random(7)
    served, refused, of_robot = Counter[str](), Counter[str](), Counter[RobotId]()
    due: list[tuple[float, RobotId, Fleet]] = []
    for fleet in fleets:
        for number in range(fleet.robots):
            robot = RobotId(fleet.tenant, f"r{number}")
            heapq.heappush(due, (chance.uniform(0, fleet.robots / fleet.per_s), robot, fleet))
    heapq.heapify(due)
    held: dict[RobotId, list[float]] = {}
    now = 0.0

    def submit(robot: RobotId) -> None:
        scheduler.submit(queued(robot.name, at=now, within=DEADLINE_S, tenant=robot.tenant))

    def receive() -> None:
        nonlocal now
        while due and due[0][0] <= now:
            at, robot, fleet = heapq.heappop(due)
            next_s = at + fleet.robots / fleet.per_s * chance.uniform(0.8, 1.2)
            if robot in held:
                held[robot].append(at)
                if len(held[robot]) == 1:
                    submit(robot)
            elif pause_s := scheduler.unread_pause_s(robot, DEADLINE_S):
                refused[fleet.tenant] += 1
                now += REFUSAL_S
                if fleet.obeys:
                    next_s = max(next_s, now + pause_s)
                else:
                    held[robot] = []
            else:
                submit(robot)
            heapq.heappush(due, (next_s, robot, fleet))

    while now < SECONDS:
        receive()
        started, late = scheduler.start(now)
        for each in [*(refusal.queued for refusal in late), *([started] if started else [])]:
            waiting = held.get(each.robot, [])
            if waiting:
                waiting.pop(0)
                if waiting:
                    submit(each.robot)
        if started is None:
            now = max(now, due[0][0])
            continue
        now += WORK_S * chance.uniform(0.7, 1.3)
        scheduler.done(started, now)
        in_time = now <= started.deadline_s
        served[started.robot.tenant] += in_time
        of_robot[started.robot] += in_time
    return served, refused, of_robot


@pytest.mark.parametrize("load", [0.5, 0.9])
def test_nothing_is_refused_below_the_capacity(load: float):
    served, refused, _ = drive(Fleet("t", 40, load * CAPACITY_PER_S))

    assert refused.total() == 0
    assert served.total() == pytest.approx(load * CAPACITY_PER_S * SECONDS, rel=0.03)


@pytest.mark.parametrize(("load", "least"), [(1.2, 0.85), (1.5, 0.8), (2.0, 0.8), (3.0, 0.75)])
@pytest.mark.parametrize("robots", [40, 100])
def test_robots_that_obey_keep_most_of_the_answers(load: float, least: float, robots: int):
    served, _, of_robot = drive(Fleet("t", robots, load * CAPACITY_PER_S))

    assert served.total() >= least * CAPACITY_PER_S * SECONDS
    assert len(of_robot) == robots, "none starves"


@pytest.mark.parametrize("others", [Fleet("evil", 20, 380.0, obeys=False), Fleet("evil", 60, 400.0)])
def test_a_tenant_that_sends_no_more_than_its_fair_part_keeps_it(others: Fleet):
    served, _, _ = drive(Fleet("good", 10, 0.45 * CAPACITY_PER_S), others)

    assert served["good"] >= 0.9 * 0.45 * CAPACITY_PER_S * SECONDS
