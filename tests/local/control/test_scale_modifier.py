"""The policy is carried out: crashed servers are replaced at once, crash loops slowly, never all at once."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.config import ScalingSettings
from rse_pf.local.control.fleet import ServerHealth
from rse_pf.local.control.scale_modifier import LocalScaleModifier, may_start_s, replace_now
from rse_pf.scaling.rules import Sample

SCALING = ScalingSettings()


class FakeServers:
    """Remembers what was asked; a replaced server leaves the dead."""

    def __init__(self, standing: ServerHealth) -> None:
        self.now = standing
        self.asked: list[tuple[Any, ...]] = []
        self.number = 10
        self.disk_is_full = False

    def is_full(self) -> bool:
        return self.disk_is_full

    def standing(self, now_s: float) -> ServerHealth:
        return self.now

    def grow(self, count: int) -> list[str]:
        self.asked.append(("grow", count))
        return [self._name() for _ in range(count)]

    def shrink(self, reason: str) -> str | None:
        self.asked.append(("shrink",))
        return "server-1" if self.now.healthy > 1 else None

    def launch_replacement(self, name: str) -> str:
        self.asked.append(("replace", name))
        return self._name()

    def _name(self) -> str:
        self.number += 1
        return f"server-{self.number}"


def made(
    standing: ServerHealth, minimum: Callable[[], int] | None = None
) -> tuple[LocalScaleModifier, FakeServers, list[Mapping[str, Any]]]:
    servers, told = FakeServers(standing), []

    def emit(event: str, **details: Any) -> None:
        told.append({"event": event, **details})

    modifier = LocalScaleModifier(
        servers,  # type: ignore[arg-type]
        SCALING,
        max_restarts_per_minute=5,
        minimum=minimum,
        emit=emit,
    )
    return modifier, servers, told


def test_in_the_fast_profile_a_busy_platform_grows_after_three_samples_and_then_each_minute() -> None:
    servers = FakeServers(ServerHealth(servers=2, healthy=2))
    modifier = LocalScaleModifier(
        servers,  # type: ignore[arg-type]
        ScalingSettings(profile="fast"),
        max_restarts_per_minute=5,
        emit=lambda event, **details: None,
    )
    grown = []
    for period in range(1, 20):
        before = len(servers.asked)
        first = max(period - 5, 0)  # a short history, as that of the monitor
        busy = [Sample(start_s=10.0 * each, cpu_percent=75.0, requests=1) for each in range(first, period)]
        modifier.act(busy, now_s=10.0 * period, period_over=True)
        grown += [10 * period] * (len(servers.asked) - before)

    assert grown == [30, 90, 150]


def test_missing_servers_are_launched_at_once_but_not_while_somebody_else_changes_the_number() -> None:
    modifier, servers, _ = made(ServerHealth(servers=1, healthy=1))

    modifier.act([], now_s=61.0, period_over=False, hold=True)
    assert servers.asked == []
    modifier.act([], now_s=61.0, period_over=False)
    assert servers.asked == [("grow", 1)]


def test_the_scheduled_minimum_holds_from_its_minute_on() -> None:
    modifier, servers, _ = made(ServerHealth(servers=2, healthy=2), minimum=lambda: scheduled)
    scheduled = 2
    modifier.act([], now_s=61.0, period_over=False)
    assert servers.asked == []

    scheduled = 4
    modifier.act([], now_s=62.0, period_over=False)

    assert servers.asked == [("grow", 2)]
    assert modifier.document()["min_servers"] == 4


def crashes(young: bool, seconds: int) -> tuple[list[float], list[Mapping[str, Any]]]:
    """Let each replacement die at once, look once a second, and return when one was started."""
    modifier, servers, told = made(ServerHealth(servers=2, healthy=1, dead={"server-1": young}))
    starts = []
    for second in range(seconds):
        before = len(servers.asked)
        modifier.act([], now_s=1000.0 + second, period_over=False)
        starts += [1000.0 + second] * (len(servers.asked) - before)
    return starts, told


def test_a_crash_loop_gets_five_starts_a_minute_and_is_reported_once() -> None:
    starts, told = crashes(young=True, seconds=180)

    assert max(sum(0 <= later - start < 60.0 for later in starts) for start in starts) == 5
    assert len(starts) == 15
    assert [event["event"] for event in told].count("crash-loop") == 1


@given(st.lists(st.floats(0.0, 300.0), max_size=30), st.integers(1, 6))
def test_whoever_obeys_never_starts_more_than_allowed_in_any_minute(wishes: list[float], most: int) -> None:
    starts: list[float] = []
    for wish in sorted(wishes):
        if may_start_s(starts, now_s=wish, per_minute=most) <= wish:
            starts.append(wish)

    for start in starts:
        assert sum(0.0 <= later - start < 60.0 for later in starts) <= most


@pytest.mark.parametrize(
    ("broken", "healthy", "replacing", "chosen"),
    [("a", 3, 0, "a"), ("abc", 4, 0, "ab"), ("abc", 4, 1, "a"), ("abcd", 0, 0, "a"), ("abc", 0, 1, "")],
)
def test_living_servers_are_never_replaced_all_at_once(
    broken: str, healthy: int, replacing: int, chosen: str
) -> None:
    assert replace_now(tuple(broken), healthy=healthy, replacing=replacing) == tuple(chosen)


def test_a_whole_fleet_that_fails_its_checks_loses_one_server_only_but_dead_ones_all() -> None:
    modifier, servers, _ = made(
        ServerHealth(
            servers=4, healthy=0, broken=("server-3", "server-4"), dead={"server-1": False, "server-2": False}
        )
    )

    modifier.act([], now_s=61.0, period_over=False)

    assert servers.asked == [("replace", "server-1"), ("replace", "server-2"), ("replace", "server-3")]


def test_on_a_full_disk_nothing_is_started_and_waiting_is_no_crash_loop() -> None:
    modifier, servers, told = made(ServerHealth(servers=2, healthy=1, dead={"server-2": True}))
    servers.disk_is_full = True
    for second in range(60):
        modifier.act((), now_s=float(second), period_over=False)
    assert (servers.asked, told) == ([], [])

    servers.disk_is_full = False
    modifier.act((), now_s=60.0, period_over=False)

    assert servers.asked == [("replace", "server-2")]


def test_a_dead_server_is_replaced_at_once_also_between_periods_and_on_hold() -> None:
    modifier, servers, told = made(ServerHealth(servers=2, healthy=1, dead={"server-1": False}))

    modifier.act([], now_s=61.0, period_over=False, hold=True)

    assert servers.asked == [("replace", "server-1")]
    assert (told[0]["event"], told[0]["server"], told[0]["by"]) == ("replace", "server-1", "server-11")


def test_servers_that_lived_long_are_replaced_however_many_they_are() -> None:
    starts, told = crashes(young=False, seconds=20)

    assert len(starts) == 20
    assert "crash-loop" not in {event["event"] for event in told}
