"""When the platform grows, shrinks, replaces and stays."""

from __future__ import annotations

import pytest

from rse_pf.config import ScalingSettings
from rse_pf.scaling.policy import Action, FleetState, decide, find_rule_starts
from rse_pf.scaling.rules import Sample

SETTINGS = ScalingSettings(min_servers=1)


def actions(
    *cpu: float, servers: int = 3, requests: float | None = None, settings: ScalingSettings = SETTINGS
) -> list[str]:
    """What is decided after each period; a loaded period has requests unless told otherwise."""
    samples = [
        Sample(start_s=60.0 * i, cpu_percent=each, requests=each if requests is None else requests)
        for i, each in enumerate(cpu)
    ]
    fleet = FleetState(servers=servers)
    return [decide(samples, fleet, settings, now_s=60.0 * (i + 1))[-1].kind for i in range(len(samples))]


def last(*cpu: float, fleet: FleetState, settings: ScalingSettings = SETTINGS) -> Action:
    samples = [Sample(start_s=60.0 * i, cpu_percent=each, requests=each) for i, each in enumerate(cpu)]
    return decide(samples, fleet, settings, now_s=60.0 * len(cpu))[-1]


def test_shrinks_only_after_five_uninterrupted_idle_minutes() -> None:
    assert actions(0, 0, 0, 0, 0) == ["stay"] * 4 + ["shrink"]
    assert actions(0, 0, 0, 30, 0, 0, 0, 0) == ["stay"] * 8


def test_a_quiet_fleet_that_still_gets_requests_is_not_idle() -> None:
    assert actions(0, 0, 0, 0, 0, 0, requests=1.0) == ["stay"] * 6


def test_grows_at_the_second_busy_minute_and_the_threshold_counts_as_busy() -> None:
    assert actions(70, 70) == ["stay", "grow"]
    assert actions(69.9, 70) == ["stay", "stay"]


def test_servers_that_warm_up_count_as_added_already() -> None:
    assert last(90, 90, fleet=FleetState(servers=4, warming=1)).servers == 1
    assert last(90, 90, fleet=FleetState(servers=5, warming=2)).kind == "stay"


def test_nothing_shrinks_while_a_server_warms_up() -> None:
    assert last(0, 0, 0, 0, 0, fleet=FleetState(servers=4, warming=1)).kind == "stay"


def test_never_leaves_the_bounds() -> None:
    assert last(99, 99, fleet=FleetState(servers=9)).servers == 1
    assert last(99, 99, fleet=FleetState(servers=10)).kind == "stay"
    assert last(0, 0, 0, 0, 0, fleet=FleetState(servers=1)).kind == "stay"


def test_too_few_servers_are_made_up_for_at_once() -> None:
    action = decide([], FleetState(servers=0), ScalingSettings(min_servers=2), now_s=0.0)[-1]

    assert (action.kind, action.servers) == ("grow", 2)


def test_a_period_without_a_sample_is_no_reason_to_act() -> None:
    samples = [Sample(start_s=60.0 * i, cpu_percent=0, requests=0) for i in (0, 1, 3, 4)]

    assert decide(samples, FleetState(servers=3), SETTINGS, now_s=300.0)[-1].kind == "stay"


def test_a_sample_speaks_for_the_period_it_began_in() -> None:
    samples = [Sample(start_s=60.0 * i, cpu_percent=80, requests=1) for i in range(2)]

    assert decide(samples, FleetState(servers=3), SETTINGS, now_s=119.0)[-1].kind == "stay"
    assert decide(samples, FleetState(servers=3), SETTINGS, now_s=120.0)[-1].kind == "grow"


def test_broken_servers_are_replaced_whatever_the_load() -> None:
    replace, scale = decide([], FleetState(servers=3, unhealthy=("b",)), SETTINGS, now_s=0.0)

    assert (replace.kind, replace.names) == ("replace", ("b",))
    assert scale.kind == "stay"


def test_too_many_robots_grow_the_fleet_when_a_limit_is_set() -> None:
    settings = ScalingSettings(max_robots_per_server=50)
    samples = [Sample(start_s=60.0 * i, cpu_percent=30, requests=1, robots_per_server=50.0) for i in range(2)]

    assert decide(samples, FleetState(servers=3), settings, now_s=120.0)[-1].servers == 1
    assert decide(samples, FleetState(servers=3), SETTINGS, now_s=120.0)[-1].kind == "stay"


def test_a_slow_robot_does_not_hold_servers_that_have_nothing_to_do() -> None:
    assert actions(*[10.0] * 15, requests=1.0) == ["stay"] * 14 + ["shrink"]
    assert actions(*[10.0] * 14, 15.0, requests=1.0) == ["stay"] * 15
    off = ScalingSettings(min_servers=1, underused_s=0)
    assert actions(*[10.0] * 15, requests=1.0, settings=off) == ["stay"] * 15


def test_a_server_that_leaves_would_not_crowd_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rse_pf.scaling.profile.BUSY_PERIODS", 20)
    scaling = ScalingSettings(min_servers=1, max_robots_per_server=60)
    few, many = (
        [Sample(start_s=60.0 * i, cpu_percent=10.0, requests=1, robots_per_server=robots) for i in range(15)]
        for robots in (29.0, 30.0)
    )

    assert decide(few, FleetState(servers=2), scaling, now_s=900.0)[-1].kind == "shrink"
    assert decide(many, FleetState(servers=2), scaling, now_s=900.0)[-1].kind == "stay"


def fast(*cpu: float, idle_s: int = 300) -> list[str]:
    """What the fast profile decides after each sample of 10 s."""
    scaling = ScalingSettings(min_servers=1, profile="fast", idle_s=idle_s)
    samples = [Sample(start_s=10.0 * i, cpu_percent=each, requests=each) for i, each in enumerate(cpu)]
    fleet = FleetState(servers=3)
    return [
        decide(samples[: i + 1], fleet, scaling, now_s=10.0 * (i + 1))[-1].kind for i in range(len(samples))
    ]


def test_the_fast_profile_grows_at_the_third_busy_sample_and_again_after_a_minute() -> None:
    assert fast(*[80.0] * 10) == ["stay", "stay", "grow", *["stay"] * 5, "grow", "stay"]
    assert fast(80, 80, 69, 80, 80, 80) == ["stay"] * 5 + ["grow"]


def test_a_rule_that_holds_for_longer_than_the_history_keeps_its_minute() -> None:
    scaling = ScalingSettings(min_servers=1, profile="fast")
    kinds: list[str] = []
    since_s: dict[str, float] = {}
    for i in range(200):
        samples = [
            Sample(start_s=10.0 * each, cpu_percent=80.0, requests=1) for each in range(max(i - 20, 0), i)
        ]
        since_s = find_rule_starts(samples, scaling, now_s=10.0 * i, before=since_s)
        kinds.append(
            decide(samples, FleetState(servers=3), scaling, now_s=10.0 * i, since_s=since_s)[-1].kind
        )

    assert [i for i, kind in enumerate(kinds) if kind == "grow"] == list(range(3, 200, 6))
