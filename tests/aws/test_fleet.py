"""The status of a fleet: what AWS says of each server, and silence where nobody told a number."""

from __future__ import annotations

import dataclasses
from datetime import datetime, timedelta, timezone
from typing import Any

import pytest

from rse_pf.aws.account import open_account
from rse_pf.aws.fleet import GROUP, Fleet, Server, look_at
from rse_pf.errors import ConfigurationError
from rse_pf.settings import PlatformSettings

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


def tell(region: str, value: float, minutes_ago: float, **more: str) -> None:
    dimensions = [{"Name": k, "Value": v} for k, v in {"AutoScalingGroupName": GROUP, **more}.items()]
    datum = {
        "MetricName": "Robots", "Dimensions": dimensions, "Value": value, "Unit": "Count",
        "Timestamp": NOW - timedelta(minutes=minutes_ago),
    }  # fmt: skip
    open_account(region).client("cloudwatch").put_metric_data(Namespace="RsePf", MetricData=[datum])


def test_servers_and_alarms_are_shown_and_untold_robots_are_not_zero(region: str, servers: list[str]) -> None:
    fleet = look_at(open_account(region), SETTINGS, now=NOW)

    assert (fleet.least, fleet.wanted, fleet.most) == (2, 2, 4)
    assert [each.name for each in fleet.servers] == servers
    assert [each.robots for each in fleet.servers] == [None, None]
    assert fleet.robots == {}
    assert list(fleet.alarms) == ["busy"]
    assert all(len(each.targets) == 1 for each in fleet.servers)


def test_the_newest_period_counts_over_all_servers_and_by_server(region: str, servers: list[str]) -> None:
    tell(region, 99, 2.5)
    tell(region, 12, 1)
    tell(region, 30, 1)
    tell(region, 12, 1, InstanceId=servers[0])

    fleet = look_at(open_account(region), SETTINGS, now=NOW)

    assert fleet.robots == {"Sum": 42, "Minimum": 12, "Maximum": 30, "SampleCount": 2}
    assert [each.robots for each in fleet.servers] == [12, None]


def test_a_number_that_is_older_than_three_periods_is_not_told(region: str, servers: list[str]) -> None:
    tell(region, 99, 5)

    assert look_at(open_account(region), SETTINGS, now=NOW).robots == {}


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
    fleet = Fleet(least=1, wanted=1, most=2, servers=(dataclasses.replace(WELL, **change),), alarms={})

    assert fleet.is_well is well


def test_a_fleet_that_lacks_a_server_is_not_well() -> None:
    assert not Fleet(least=2, wanted=2, most=2, servers=(WELL,), alarms={}).is_well
