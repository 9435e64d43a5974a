"""A group of two servers on an emulated AWS, and times at which no other test publishes numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone

import pytest

from rse_pf.aws.account import open_account
from rse_pf.aws.fleet.metrics import ServerMetrics, datums
from rse_pf.config.resource_names import ResourceNames
from rse_pf.scaling.alarms import NAMESPACE
from tests.kit.emulated_aws import REGION, emulated_aws

__all__ = ["GROUP", "now", "publish", "region", "servers"]

GROUP = ResourceNames().group
_START = datetime.now(timezone.utc).replace(second=0, microsecond=0)
_HOURS = itertools.count(1)


@pytest.fixture(scope="module")
def region() -> Iterator[str]:
    """An emulated region that the tests of this module share."""
    with pytest.MonkeyPatch.context() as patch, emulated_aws(patch, __name__):
        yield REGION


@pytest.fixture
def now() -> datetime:
    """A minute of its own for each test, in which no other test has published anything."""
    return _START - timedelta(hours=next(_HOURS))


@pytest.fixture(scope="module")
def servers(region: str) -> list[str]:
    """Two instances in a group with one target group and one alarm."""
    account = open_account(region)
    ec2, elb = account.client("ec2"), account.client("elbv2")
    vpc = ec2.describe_vpcs()["Vpcs"][0]["VpcId"]
    targets = elb.create_target_group(Name="robots", Protocol="HTTP", Port=8765, VpcId=vpc)["TargetGroups"][0]
    subnets = [each["SubnetId"] for each in ec2.describe_subnets()["Subnets"]][:2]
    (balancer,) = elb.create_load_balancer(Name="rse-pf", Subnets=subnets, Type="network")["LoadBalancers"]
    elb.create_listener(
        LoadBalancerArn=balancer["LoadBalancerArn"], Protocol="TCP", Port=80,
        DefaultActions=[{"Type": "forward", "TargetGroupArn": targets["TargetGroupArn"]}],
    )  # fmt: skip
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
        AlarmName="rse-pf/busy", MetricName="m", Namespace="n", Statistic="Sum", Period=60, Threshold=1,
        EvaluationPeriods=1, ComparisonOperator="GreaterThanThreshold",
    )  # fmt: skip
    (group,) = account.client("autoscaling").describe_auto_scaling_groups()["AutoScalingGroups"]
    return sorted(each["InstanceId"] for each in group["Instances"])


def publish(region: str, server: str, robots: int, when: datetime) -> None:
    """Publish what an agent publishes, as of *when*."""
    reading = ServerMetrics(robots=robots)
    data = [{**datum, "Timestamp": when} for datum in datums(reading, reading, GROUP, server)]
    open_account(region).client("cloudwatch").put_metric_data(Namespace=NAMESPACE, MetricData=data)
