"""Requests and services that crash sandboxes repeatedly are refused, but only to whom they crashed."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, WorkerLost
from rse_pf.identity import RobotId
from rse_pf.server.sandbox.circuit_breaker import POISON_S, Block, CircuitBreaker

SETTINGS = PlatformSettings.from_dict({"services": {"breaker_crashes": 3}}).services
ONE, TWO, THREE, FOUR = (RobotId("acme", f"robot-{i}") for i in range(1, 5))
RIVAL, RIVAL_2, NAMESAKE = (
    RobotId("rival", "robot-9"),
    RobotId("rival", "robot-8"),
    RobotId("rival", "robot-1"),
)
OTHER = RobotId("third", "robot-1")


def code(refusal: RsePfError | None) -> str:
    """Return the error code of a refusal, "" for none."""
    return "" if refusal is None else refusal.code


def crashing(robots: Iterable[RobotId], *, apart_s: float = 0.1, digest: str = "") -> CircuitBreaker:
    """Return a breaker that saw a crash of icp for each of *robots*: of *digest*, or of others."""
    breaker = CircuitBreaker(SETTINGS)
    for i, robot in enumerate(robots):
        breaker.note_crash(robot, "icp", digest or str(i), i * apart_s)
    return breaker


def refused(breaker: CircuitBreaker, *robots: RobotId, digest: str = "new", now: float = 1.0) -> list[str]:
    """Return the error code of a request of each robot."""
    return [code(breaker.refusal(robot, "icp", digest, now)) for robot in robots]


# --- one robot -------------------------------------------------------------------------------------


def test_a_request_that_crashed_twice_is_poison_for_its_robot_alone():
    breaker = CircuitBreaker(SETTINGS)
    breaker.note_crash(ONE, "icp", "a", 0.0)
    assert refused(breaker, ONE, digest="a") == [""]
    breaker.note_crash(ONE, "icp", "a", 100.0)

    assert refused(breaker, ONE, TWO, NAMESAKE, digest="a", now=200.0) == ["poison", "", ""]
    assert refused(breaker, ONE, digest="b", now=200.0) == [""]


def test_a_poison_request_is_tried_again_ten_minutes_after_its_crashes():
    breaker = crashing([ONE, ONE], apart_s=0.0, digest="a")

    assert refused(breaker, ONE, digest="a", now=POISON_S - 0.1) == ["poison"]
    assert refused(breaker, ONE, digest="a", now=POISON_S) == [""]
    breaker.note_crash(ONE, "icp", "a", POISON_S)
    assert refused(breaker, ONE, digest="a", now=POISON_S) == [""], "one new crash is not enough"


def test_three_crashes_in_half_a_minute_open_the_breaker_of_a_service_for_a_minute():
    breaker = CircuitBreaker(SETTINGS)
    for now, digest in ((0.0, "a"), (20.0, "b"), (30.0, "c")):
        assert refused(breaker, ONE, now=now) == [""]
        breaker.note_crash(ONE, "icp", digest, now)

    assert refused(breaker, ONE, TWO, NAMESAKE, now=30.1) == ["worker-lost", "", ""]
    assert breaker.refusal(ONE, "other", "d", 30.1) is None
    refusal = breaker.refusal(ONE, "icp", "d", 80.0)
    assert isinstance(refusal, WorkerLost)
    assert refusal.retry_after_ms == 10_000.0
    assert refused(breaker, ONE, now=90.0) == [""]


def test_crashes_further_apart_do_not_open_the_breaker():
    breaker = crashing([ONE] * 20, apart_s=15.1)

    assert refused(breaker, ONE, now=20 * 15.1) == [""]


def test_after_it_closed_the_breaker_needs_as_many_crashes_again():
    breaker = crashing([ONE] * 3, apart_s=1.0)
    breaker.note_crash(ONE, "icp", "late", 62.0)
    breaker.note_crash(ONE, "icp", "later", 63.0)
    assert refused(breaker, ONE, now=64.0) == [""]

    breaker.note_crash(ONE, "icp", "last", 64.0)
    assert refused(breaker, ONE, now=64.0) == ["worker-lost"]


# --- deadlines -------------------------------------------------------------------------------------


def test_the_deadlines_of_robots_are_evidence_neither_against_a_service_nor_against_a_request():
    breaker = CircuitBreaker(SETTINGS)
    for i in range(600):
        for robot in (ONE, TWO, THREE, RIVAL, RIVAL_2, OTHER):
            breaker.note_overrun(robot, "icp", float(i))

    assert refused(breaker, FOUR, RobotId("rival", "x"), RobotId("new", "x"), now=600.0) == ["", "", ""]
    assert breaker.open_services(600.0) == []
    assert {block.reason for block in breaker.blocks(600.0)} == {"overruns"}


def test_a_robot_whose_deadline_is_overrun_again_and_again_is_refused_the_service_and_told_why():
    breaker = CircuitBreaker(SETTINGS)
    for i in range(3):
        breaker.note_overrun(ONE, "icp", float(i))

    assert refused(breaker, ONE, TWO, NAMESAKE, now=3.0) == ["worker-lost", "", ""]
    refusal = breaker.refusal(ONE, "icp", "a", 3.0)
    assert refusal is not None
    assert "longer deadline" in refusal.hint
    assert refused(breaker, ONE, now=62.1) == [""]


# --- several robots, several tenants ---------------------------------------------------------------


def test_two_robots_of_a_tenant_are_not_enough_to_refuse_a_service_to_a_third():
    breaker = crashing([ONE, TWO] * 3)

    assert refused(breaker, THREE) == [""]
    assert refused(breaker, ONE, TWO) == ["worker-lost"] * 2


def test_crashes_of_three_robots_open_the_breaker_for_their_tenant():
    breaker = crashing([ONE, TWO, THREE])

    assert refused(breaker, FOUR, RIVAL) == ["worker-lost", ""]
    assert breaker.open_services(1.0) == ["icp"]
    assert breaker.open_services(61.0) == []


def test_no_tenant_takes_a_service_or_a_request_from_the_robots_of_others():
    breaker = CircuitBreaker(SETTINGS)
    for i in range(100):
        for request in ("same", str(i)):
            breaker.note_crash(RobotId("hostile", f"robot-{i}"), "icp", request, i * 0.01)
    breaker.note_crash(ONE, "icp", "same", 1.0)

    assert refused(breaker, ONE, TWO, RIVAL, now=1.1) == ["", "", ""]
    assert refused(breaker, ONE, TWO, RIVAL, digest="same", now=1.1) == ["", "", ""]
    assert refused(breaker, RobotId("hostile", "new"), digest="same", now=1.1) == ["poison"]


@pytest.mark.parametrize(
    ("robots", "is_open_for_all"),
    [
        ([ONE, TWO, THREE, RIVAL], False),
        ([ONE, TWO, RIVAL, RIVAL], False),
        ([ONE, TWO, RIVAL, RIVAL_2], True),
        ([ONE, RIVAL, OTHER], True),
        ([ONE, ONE, ONE, ONE, RIVAL, OTHER], True),
        ([ONE, ONE, RIVAL, RIVAL], False),
    ],
)
def test_a_service_is_refused_to_all_once_two_robots_outside_the_largest_tenant_crashed_too(
    robots: list[RobotId], is_open_for_all: bool
):
    stranger = RobotId("unconcerned", "robot")

    assert refused(crashing(robots), stranger) == ["worker-lost" if is_open_for_all else ""]
    assert refused(crashing(robots, digest="x"), stranger, digest="x") == [
        "poison" if is_open_for_all else ""
    ]


def test_robots_of_one_name_in_three_tenants_are_three_robots():
    breaker = crashing([RobotId(tenant, "robot-1") for tenant in ("a", "b", "c")])

    assert refused(breaker, OTHER) == ["worker-lost"]


def test_a_name_that_was_enrolled_again_has_nothing_of_its_predecessor():
    breaker = crashing([RobotId("acme", "robot-1", "old")] * 3)

    assert refused(breaker, RobotId("acme", "robot-1", "new")) == [""]


def test_blocks_are_listed_with_reason_robots_and_time_and_those_of_most_robots_first():
    breaker = crashing([ONE, TWO, THREE], digest="a")
    breaker.note_crash(ONE, "icp", "a", 0.2)
    for _ in range(3):
        breaker.note_overrun(NAMESAKE, "pose", 0.2)

    assert breaker.blocks(0.2) == [
        Block(service="icp", reason="crashes", tenant="acme", robot=None, requests=0, left_s=60.0),
        Block(service="icp", reason="poison", tenant="acme", robot=None, requests=1, left_s=599.9),
        Block(service="icp", reason="poison", tenant="acme", robot="robot-1", requests=1, left_s=599.8),
        Block(service="pose", reason="overruns", tenant="rival", robot="robot-1", requests=0, left_s=60.0),
    ]
    assert breaker.blocks(POISON_S + 1.0) == []


def test_an_operator_lifts_everything_and_the_evidence_is_forgotten():
    breaker = crashing([ONE, TWO, THREE, ONE, TWO, THREE], digest="a")
    lifted = breaker.unblock(1.0)

    assert {(block.reason, block.robot) for block in lifted} >= {("crashes", None), ("poison", "robot-1")}
    assert breaker.blocks(1.0) == []
    assert refused(breaker, ONE, digest="a") == [""]
    breaker.note_crash(ONE, "icp", "a", 1.0)
    assert refused(breaker, ONE, TWO, digest="a") == ["", ""]


def test_an_operator_lifts_what_concerns_one_service():
    breaker = crashing([ONE] * 3)
    for i in range(3):
        breaker.note_crash(ONE, "pose", str(i), 1.0)

    assert [block.service for block in breaker.unblock(1.0, service="pose")] == ["pose"]
    assert [block.service for block in breaker.blocks(1.0)] == ["icp"]


# --- the operator ----------------------------------------------------------------------------------


def test_an_operator_lifts_what_concerns_one_tenant_or_one_robot():
    robots = [ONE, RobotId("rival", "robot-1"), RobotId("acme", "robot-2")]
    breaker = crashing([robot for robot in robots for _ in range(3)], digest="a")

    lifted = breaker.unblock(1.0, tenant="acme", robot="robot-1")
    assert {(block.tenant, block.robot) for block in lifted} == {("acme", "robot-1")}
    assert refused(breaker, *robots, digest="a") == ["", "poison", "poison"]

    breaker.unblock(1.0, tenant="rival")
    assert refused(breaker, *robots, digest="a") == ["", "", "poison"]


def test_what_is_refused_to_all_is_not_lifted_for_one_tenant():
    breaker = crashing([ONE, RIVAL, OTHER])

    assert breaker.unblock(1.0, tenant="acme") == []
    assert refused(breaker, FOUR) == ["worker-lost"]


def test_poison_expires_also_while_other_requests_crash():
    breaker = CircuitBreaker(SETTINGS)
    for now in (0.0, 0.0, 1e6):
        breaker.note_crash(ONE, "icp", "old" if now == 0.0 else "new", now)

    assert refused(breaker, ONE, digest="old", now=1e6) == [""]


# --- memory ----------------------------------------------------------------------------------------


def test_the_oldest_requests_are_forgotten_when_ten_thousand_crashed():
    breaker = CircuitBreaker(SETTINGS)
    for i in range(12_000):
        breaker.note_crash(ONE, f"service-{i % 1000}", str(i), i * 0.001)
    breaker.note_crash(ONE, "icp", "new", 12.0)
    breaker.note_crash(ONE, "icp", "new", 12.0)

    assert refused(breaker, ONE, digest="new", now=13.0) == ["poison"]
    breaker.note_crash(ONE, "service-0", "0", 12.0)
    assert breaker.refusal(ONE, "service-0", "0", 100.0) is None, "its first crash is forgotten by now"


def test_one_request_of_many_robots_takes_no_more_than_some_of_them():
    breaker = crashing([RobotId(f"tenant-{i}", "robot") for i in range(500)], apart_s=0.001, digest="a")

    poison = [block for block in breaker.blocks(1.0) if block.reason == "poison"]
    assert len(poison) == 1, "for all"
