"""Synthetic robots, such as the canary, are no load: the fleet shrinks although they send commands."""

from __future__ import annotations

import pytest

from rse_pf.auth.roster import SYNTHETIC, check_scopes, scopes_allow
from rse_pf.config import ScalingSettings
from rse_pf.errors import UsageError
from rse_pf.scaling.alarms import alarms_of
from tests.kit.fleet_traffic import Robot, measure_traffic
from tests.scaling.test_one_policy import Cloud, Local

SCALING = ScalingSettings()
SERVERS = 10
CANARY = Robot(name="rse-pf-canary", scopes=("services:pnp", "services:echo", SYNTHETIC))
MINUTES = 20
ONCE_A_MINUTE = Robot(name="slow")

LOADS = {
    "the canary": ([CANARY], True),
    "no robot at all, the canary is disabled": ([], True),
    "a canary of another name": ([Robot(name="probe-7", scopes=CANARY.scopes)], True),
    "two canaries": ([CANARY, Robot(name="second", scopes=CANARY.scopes)], True),
    "a canary whose commands fail": ([Robot(name="c", scopes=CANARY.scopes, works=False)], True),
    "a canary that is not always there": ([Robot(name="c", scopes=CANARY.scopes, active=(0, 3, 4, 9))], True),
    "the fleet page": ([Robot(name="fleet-page", scopes=("maps:live", SYNTHETIC), stays=True)], True),
    "the canary and one robot at one frame a minute": ([CANARY, ONCE_A_MINUTE], False),
    "one robot at one frame a minute": ([ONCE_A_MINUTE], False),
    "one robot whose commands fail": ([Robot(name="r", works=False)], False),
    "one robot that may do what the canary may": ([Robot(name="r", scopes=("services:echo",))], False),
}


def servers_after_each_minute(robots: list[Robot], side: Cloud | Local) -> list[int]:
    """Return the size of a fleet of `SERVERS`, whose CPU is at 17 %: idle, but not underused."""
    side.launched = [-1e9] * SERVERS
    trace = []
    for minute, traffic in enumerate(measure_traffic(robots, MINUTES)):
        is_cloud = isinstance(side, Cloud)
        requests = traffic.cloud["Requests"] if is_cloud else traffic.local_requests
        connected = traffic.cloud["Robots"] if is_cloud else traffic.local_robots
        point = {
            "cpu": 17.0,
            "requests": float(requests),
            "robots": connected / len(side.launched),
            "queue": 0.0,
        }
        side.period(point, (minute + 1) * 60.0)
        trace.append(len(side.launched))
    return trace


@pytest.mark.parametrize("name", LOADS)
def test_only_robots_that_are_not_synthetic_keep_idle_servers(name: str) -> None:
    robots, shrinks = LOADS[name]

    cloud = servers_after_each_minute(robots, Cloud(alarms_of(SCALING), SCALING))
    local = servers_after_each_minute(robots, Local(SCALING))

    assert cloud == local
    if shrinks:
        assert cloud[5] < SERVERS, "the first server leaves within six minutes"
        assert cloud[-1] == SCALING.min_servers
    else:
        assert set(cloud) == {SERVERS}


def test_a_robot_counts_as_connected_unless_it_is_synthetic() -> None:
    page = Robot(name="fleet-page", scopes=("maps:live", SYNTHETIC), stays=True)
    (traffic,) = measure_traffic([page, Robot(name="r", stays=True)], 1)

    assert (traffic.cloud["Robots"], traffic.local_robots) == (1.0, 1)
    assert (traffic.cloud["Requests"], traffic.local_requests) == (1.0, 1)


def test_the_scope_of_synthetic_robots_is_valid_and_allows_nothing() -> None:
    assert check_scopes((SYNTHETIC,)) == (SYNTHETIC,)
    assert not scopes_allow((SYNTHETIC,), "services:echo")
    with pytest.raises(UsageError):
        check_scopes(("synthetic:yes",))
