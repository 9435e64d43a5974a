"""A robot's requests are limited by its rate, by those in progress, and by the memory for bodies."""

from __future__ import annotations

import pytest

from rse_pf.config import DataSettings
from rse_pf.data_server.http import HttpRequest, TooManyRequests
from rse_pf.data_server.request_limits import MAX_REQUESTS_PER_ROBOT, RequestLimits
from rse_pf.errors import Busy
from rse_pf.identity import RobotId

ROBOT, OTHER = RobotId("acme", "robot-1"), RobotId("rival", "robot-1")


def admission(**settings: float) -> RequestLimits:
    return RequestLimits(DataSettings(**{"max_requests_per_s": 10.0, **settings}))  # type: ignore[arg-type]


async def nothing() -> dict[str, str]:
    return {"type": "http.disconnect"}


def begin(
    gate: RequestLimits, robot: RobotId, cost: float = 1.0, now: float = 0.0, *, body: bool = False
) -> HttpRequest:
    request = HttpRequest(
        {"method": "GET", "path": "/", "headers": [], "query_string": b""}, nothing, lambda: now
    )
    gate.begin(request, robot, cost, now, has_body=body)
    return request


def ask(gate: RequestLimits, robot: RobotId, now: float, cost: float = 1.0) -> None:
    gate.end(begin(gate, robot, cost, now))


def test_a_robot_beyond_its_rate_gets_the_time_to_come_back_and_others_are_served() -> None:
    gate = admission()
    for _ in range(40):  # four seconds' worth may come at once
        ask(gate, ROBOT, now=0.0)

    with pytest.raises(TooManyRequests) as refused:
        ask(gate, ROBOT, now=0.0)

    assert refused.value.retry_after_ms == pytest.approx(100.0)
    ask(gate, OTHER, now=0.0)
    ask(gate, ROBOT, now=0.1)


def test_bodies_are_limited_for_a_robot_its_tenant_and_all() -> None:
    gate = admission(max_uploads=8)
    robots = [RobotId("acme", f"robot-{number}") for number in range(4)]

    for robot in robots[:3]:
        first, _ = (begin(gate, robot, body=True) for _ in range(2))
        with pytest.raises(Busy, match="this robot"):
            begin(gate, robot, body=True)
    with pytest.raises(Busy, match="this tenant"):
        begin(gate, robots[3], body=True)
    for robot in (OTHER, OTHER._replace(tenant="third")):
        begin(gate, robot, body=True)
    with pytest.raises(Busy, match="all robots"):
        begin(gate, OTHER, body=True)
    gate.end(first)
    begin(gate, OTHER, body=True)


def test_the_names_of_robots_that_come_and_go_take_no_memory() -> None:
    gate = admission()
    for number in range(30_000):
        ask(gate, RobotId("acme", f"robot-{number}"), now=float(number))

    assert gate.known_robots <= 10_001


def test_a_robot_has_a_limit_of_requests_in_progress() -> None:
    gate = admission()
    first, *_ = [begin(gate, ROBOT) for _ in range(MAX_REQUESTS_PER_ROBOT)]

    with pytest.raises(TooManyRequests, match=f"{MAX_REQUESTS_PER_ROBOT} requests"):
        begin(gate, ROBOT)

    begin(gate, OTHER)
    gate.end(first)
    begin(gate, ROBOT)


def test_an_expensive_request_counts_for_several() -> None:
    gate = admission()
    for _ in range(2):
        ask(gate, ROBOT, now=0.0, cost=20.0)

    with pytest.raises(TooManyRequests):
        ask(gate, ROBOT, now=0.0)
