"""The status of a fleet: what AWS says of each server, and silence where nobody told a number."""

from __future__ import annotations

import dataclasses
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from aws.fleet.fake_machine import FakeMachine, FakeScaling

from rse_pf.aws.account import open_account
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.agent import Agent, AgentConfig
from rse_pf.aws.fleet.fleet import GROUP, AutoScalingGroup, Server, look_at
from rse_pf.aws.fleet.metrics import ServerMetrics, datums
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.object_store import MemoryStore
from rse_pf.scaling.alarms import NAMESPACE

SETTINGS = PlatformSettings()
NOW = datetime.now(timezone.utc).replace(second=0, microsecond=0)
WELL = Server(name="i-1", zone="a", state="InService", targets=("healthy",), robots=None)


@pytest.fixture
def servers(region: str) -> list[str]:
    """Two instances in a group with one target group and one alarm."""
    account = open_account(region)
    ec2, elb = account.client("ec2"), account.client("elbv2")
    vpc = ec2.describe_vpcs()["Vpcs"][0]["VpcId"]
    targets = elb.create_target_group(Name="robots", Protocol="HTTP", Port=8765, VpcId=vpc)["TargetGroups"][0]
    image = ec2.describe_images()["Images"][0]["ImageId"]
    ec2.create_launch_template(
        LaunchTemplateName="servers", LaunchTemplateData={"ImageId": image, "InstanceType": "c7i.large"}
    )
    account.client("autoscaling").create_auto_scaling_group(
        AutoScalingGroupName=GROUP, MinSize=2, MaxSize=4, AvailabilityZones=[f"{region}a"],
        LaunchTemplate={"LaunchTemplateName": "servers", "Version": "$Latest"},
        TargetGroupARNs=[targets["TargetGroupArn"]],
    )  # fmt: skip
    account.client("cloudwatch").put_metric_alarm(
        AlarmName="rse-pf-busy", MetricName="m", Namespace="n", Statistic="Sum", Period=60, Threshold=1,
        EvaluationPeriods=1, ComparisonOperator="GreaterThanThreshold",
    )  # fmt: skip
    (group,) = account.client("autoscaling").describe_auto_scaling_groups()["AutoScalingGroups"]
    return sorted(each["InstanceId"] for each in group["Instances"])


def tell(region: str, server: str, robots: int, minutes_ago: float) -> None:
    """Publish what an agent publishes, as of some minutes ago."""
    reading = ServerMetrics(robots=robots)
    when = NOW - timedelta(minutes=minutes_ago)
    data = [{**datum, "Timestamp": when} for datum in datums(reading, reading, GROUP, server)]
    open_account(region).client("cloudwatch").put_metric_data(Namespace=NAMESPACE, MetricData=data)


def test_servers_and_alarms_are_shown_and_untold_robots_are_not_zero(region: str, servers: list[str]) -> None:
    fleet = look_at(open_account(region), SETTINGS, now=NOW)

    assert (fleet.least, fleet.wanted, fleet.most) == (2, 2, 4)
    assert [each.name for each in fleet.servers] == servers
    assert [each.robots for each in fleet.servers] == [None, None]
    assert fleet.robots == ()
    assert list(fleet.alarms) == ["busy"]
    assert all(len(each.targets) == 1 for each in fleet.servers)


def test_each_server_has_the_robots_that_its_agent_published_last(region: str, servers: list[str]) -> None:
    tell(region, servers[0], 99, 2.5)
    tell(region, servers[0], 12, 1)
    tell(region, servers[1], 30, 1)

    fleet = look_at(open_account(region), SETTINGS, now=NOW)

    assert [each.robots for each in fleet.servers] == [12, 30]
    assert fleet.robots == (12, 30)


def test_what_a_running_agent_publishes_is_what_the_status_shows(
    region: str, servers: list[str], tmp_path: Path
) -> None:
    machine = FakeMachine()
    machine.instance_id = lambda: servers[0]  # type: ignore[method-assign]
    machine.text = "rse_pf_robots 7\n"
    post = AgentConfig(group=GROUP, hook="h", keys_name="k", keys_file=tmp_path / "keys.json")
    Agent(
        machine, cloudwatch=make_client("cloudwatch", region), autoscaling=FakeScaling(machine), post=post,
        artifacts=MemoryStore(), settings=SETTINGS, log=lambda event, **fields: None, clock=machine.clock,
        rest=machine.rest,
    ).step()  # fmt: skip

    fleet = look_at(open_account(region), SETTINGS, now=datetime.now(timezone.utc) + timedelta(minutes=1))

    assert [each.robots for each in fleet.servers] == [7, None]


def test_the_period_that_runs_is_left_out_so_that_no_server_is_missing_from_the_sum(
    region: str, servers: list[str]
) -> None:
    for server, robots in zip(servers, (12, 30), strict=True):
        tell(region, server, robots, 1)
    tell(region, servers[0], 13, 0)  # the other's agent comes later in this minute

    fleet = look_at(open_account(region), SETTINGS, now=NOW + timedelta(seconds=20))

    assert fleet.robots == (12, 30)


def test_a_number_that_is_older_than_three_periods_is_not_told(region: str, servers: list[str]) -> None:
    tell(region, servers[0], 99, 5)

    assert look_at(open_account(region), SETTINGS, now=NOW).robots == ()


def test_without_a_platform_the_hint_says_to_deploy(region: str) -> None:
    with pytest.raises(ConfigurationError) as told:
        look_at(open_account(region), SETTINGS, now=NOW)

    assert "cdk deploy" in told.value.hint


@pytest.mark.parametrize(
    ("change", "well"),
    [
        ({}, True),
        ({"targets": ("healthy", "unhealthy")}, False),
        ({"targets": ()}, False),
        ({"state": "Terminating:Wait"}, False),
    ],
)
def test_a_fleet_is_well_when_all_wanted_servers_are_healthy_everywhere(
    change: dict[str, Any], well: bool
) -> None:
    fleet = AutoScalingGroup(
        least=1, wanted=1, most=2, servers=(dataclasses.replace(WELL, **change),), alarms={}
    )

    assert fleet.is_well is well


def test_a_fleet_that_lacks_a_server_is_not_well() -> None:
    assert not AutoScalingGroup(least=2, wanted=2, most=2, servers=(WELL,), alarms={}).is_well
