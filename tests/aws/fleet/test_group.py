"""The state of the group: what AWS reports of each server, and None where no agent published a number."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from aws.conftest import REGION
from aws.fleet.fake_machine import FakeMachine, FakeScaling

from rse_pf.aws.account import open_account
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.agent import Agent, AgentConfig
from rse_pf.aws.fleet.group import GROUP, AutoScalingGroup, Server, read_group
from rse_pf.aws.fleet.metrics import ServerMetrics, datums
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.object_store import MemoryStore
from rse_pf.scaling.alarms import NAMESPACE

SETTINGS = PlatformSettings()
START = datetime.now(timezone.utc).replace(second=0, microsecond=0)
HOURS = itertools.count(1)
HEALTHY = Server(name="i-1", zone="a", state="InService", targets=("healthy",), robots=None)


@pytest.fixture(scope="module")
def region() -> Iterator[str]:
    """An emulated region that the tests of this module share."""
    moto = pytest.importorskip("moto", reason="the dev extra is not installed")
    with pytest.MonkeyPatch.context() as patch, moto.mock_aws():
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "testing")
        yield REGION


@pytest.fixture
def now() -> datetime:
    """A minute of its own for each test, in which no other test has published anything."""
    return START - timedelta(hours=next(HOURS))


@pytest.fixture(scope="module")
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


def publish(region: str, server: str, robots: int, when: datetime) -> None:
    """Publish what an agent publishes, as of *when*."""
    reading = ServerMetrics(robots=robots)
    data = [{**datum, "Timestamp": when} for datum in datums(reading, reading, GROUP, server)]
    open_account(region).client("cloudwatch").put_metric_data(Namespace=NAMESPACE, MetricData=data)


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
    config = AgentConfig(group=GROUP, hook="h", keys_name="k", keys_file=tmp_path / "keys.json")
    Agent(
        machine, cloudwatch=make_client("cloudwatch", region), autoscaling=FakeScaling(machine),
        config=config, artifacts=MemoryStore(), settings=SETTINGS, log=lambda event, **fields: None,
        clock=machine.clock, sleep=machine.sleep,
    ).step()  # fmt: skip

    group = read_group(open_account(region), SETTINGS, now=datetime.now(timezone.utc) + timedelta(minutes=1))

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

    assert "cdk deploy" in told.value.hint


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


def test_a_group_that_lacks_a_server_is_not_healthy() -> None:
    assert not AutoScalingGroup(
        min_servers=2, wanted_servers=2, max_servers=2, servers=(HEALTHY,), alarms={}
    ).is_healthy
