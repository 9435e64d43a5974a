"""The state of the group: what AWS reports of each server, and None where no agent published a number."""

from __future__ import annotations

import dataclasses
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import open_account
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.agent import Agent
from rse_pf.aws.fleet.group import AutoScalingGroup, Server, read_group
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from tests.kit.emulated_group import GROUP, now, publish, region, servers
from tests.kit.fake_machine import FakeMachine, FakeScaling, agent_context

__all__ = ["now", "region", "servers"]
SETTINGS = PlatformSettings()
HEALTHY = Server(name="i-1", zone="a", state="InService", targets=("healthy",), robots=None)


def test_servers_and_alarms_are_shown_and_unknown_robots_are_not_zero(
    region: str, servers: list[str], now: datetime
) -> None:
    group = read_group(open_account(region), SETTINGS, now=now)

    assert (group.min_servers, group.wanted_servers, group.max_servers) == (2, 2, 4)
    assert [each.name for each in group.servers] == servers
    assert [each.robots for each in group.servers] == [None, None]
    assert group.robots == ()
    assert list(group.alarms) == ["busy"]
    assert all(len(each.targets) == 1 for each in group.servers)


def test_each_server_has_the_robots_that_its_agent_published_last(
    region: str, servers: list[str], now: datetime
) -> None:
    publish(region, servers[0], 99, now - timedelta(minutes=2.5))
    publish(region, servers[0], 12, now - timedelta(minutes=1))
    publish(region, servers[1], 30, now - timedelta(minutes=1))

    group = read_group(open_account(region), SETTINGS, now=now)

    assert [each.robots for each in group.servers] == [12, 30]
    assert group.robots == (12, 30)


def test_the_status_shows_what_a_running_agent_publishes(
    region: str, servers: list[str], tmp_path: Path
) -> None:
    machine = FakeMachine()
    machine.instance_id = lambda: servers[0]  # type: ignore[method-assign]
    machine.text = "rse_pf_robots 7\n"
    clients = {"cloudwatch": make_client("cloudwatch", region), "autoscaling": FakeScaling(machine)}
    agent = Agent(agent_context(machine, tmp_path, group=GROUP, clients=clients, settings=SETTINGS))
    agent.step()
    machine.sleep(60.0)
    agent.step()

    then = datetime.fromtimestamp(machine.wall_clock(), timezone.utc) + timedelta(minutes=1)
    group = read_group(open_account(region), SETTINGS, now=then)

    assert [each.robots for each in group.servers] == [7, None]


def test_the_current_period_is_left_out_so_that_no_server_is_missing_from_the_sum(
    region: str, servers: list[str], now: datetime
) -> None:
    for server, robots in zip(servers, (12, 30), strict=True):
        publish(region, server, robots, now - timedelta(minutes=1))
    publish(region, servers[0], 13, now)  # the other's agent comes later in this minute

    group = read_group(open_account(region), SETTINGS, now=now + timedelta(seconds=20))

    assert group.robots == (12, 30)


def test_a_number_older_than_three_periods_is_unknown(region: str, servers: list[str], now: datetime) -> None:
    publish(region, servers[0], 99, now - timedelta(minutes=5))

    assert read_group(open_account(region), SETTINGS, now=now).robots == ()


def test_without_a_platform_the_hint_says_to_deploy(region: str, now: datetime) -> None:
    with pytest.raises(ConfigurationError) as told:
        read_group(open_account("us-east-1"), SETTINGS, now=now)

    assert "rse-pf cloud up" in told.value.hint


@pytest.mark.parametrize(
    ("change", "healthy"),
    [
        ({}, True),
        ({"targets": ("healthy", "unhealthy")}, False),
        ({"targets": ()}, False),
        ({"state": "Terminating:Wait"}, False),
    ],
)
def test_a_group_is_healthy_when_all_wanted_servers_are_healthy_everywhere(
    change: dict[str, Any], healthy: bool
) -> None:
    group = AutoScalingGroup(
        min_servers=1,
        wanted_servers=1,
        max_servers=2,
        servers=(dataclasses.replace(HEALTHY, **change),),
        alarms={},
    )

    assert group.is_healthy is healthy
