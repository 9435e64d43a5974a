"""Warm pool, Spot, instance types, zones and schedule of the group, each by its settings."""

from __future__ import annotations

import shutil
from typing import Any

import pytest

from rse_pf.config import PlatformSettings

OFFICE = "weekdays 08:00 min 4; fri-sat 18:30 min 1"


def resources(**groups: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Return the properties of every resource of a small stack with one group, by type."""
    if shutil.which("node") is None:
        pytest.skip("the CDK needs Node.js")
    cdk = pytest.importorskip("aws_cdk", reason="run make setup")
    from aws_cdk import assertions, aws_autoscaling, aws_ec2

    from stacks.capacity import Capacity

    settings = PlatformSettings.from_dict(groups)
    stack = cdk.Stack(cdk.App(), "Test")
    vpc = aws_ec2.Vpc(stack, "Vpc", max_azs=2, nat_gateways=0)
    group = aws_autoscaling.AutoScalingGroup(
        stack, "Group", vpc=vpc, min_capacity=settings.scaling.min_servers, max_capacity=9,
        vpc_subnets=aws_ec2.SubnetSelection(subnet_type=aws_ec2.SubnetType.PUBLIC),
        launch_template=aws_ec2.LaunchTemplate(
            stack, "Template", instance_type=aws_ec2.InstanceType(settings.cloud.instance_type),
            machine_image=aws_ec2.MachineImage.generic_linux({"us-east-1": "ami-1"}),
        ),
    )  # fmt: skip
    Capacity(stack, "Capacity", group=group, settings=settings)
    found: dict[str, list[dict[str, Any]]] = {}
    for each in assertions.Template.from_stack(stack).to_json()["Resources"].values():
        found.setdefault(each["Type"].rpartition("::")[2], []).append(each.get("Properties", {}))
    return found


def test_by_default_servers_are_on_demand_of_one_type_in_equally_full_zones() -> None:
    made = resources()
    (group,) = made["AutoScalingGroup"]

    assert len(group["VPCZoneIdentifier"]) == 2
    assert group["AvailabilityZoneDistribution"] == {"CapacityDistributionStrategy": "balanced-best-effort"}
    assert "LaunchTemplate" in group
    assert not {"MixedInstancesPolicy", "CapacityRebalance"} & group.keys()
    assert not {"WarmPool", "ScheduledAction"} & made.keys()


def test_a_warm_pool_holds_exactly_its_stopped_servers() -> None:
    (pool,) = resources(cloud={"warm_servers": 2}, scaling={"min_servers": 3})["WarmPool"]

    del pool["AutoScalingGroupName"]
    assert pool == {
        "InstanceReusePolicy": {"ReuseOnScaleIn": False}, "MaxGroupPreparedCapacity": 2, "MinSize": 2,
        "PoolState": "Stopped",
    }  # fmt: skip


def test_spot_servers_stand_on_a_floor_on_demand_and_are_replaced_before_they_are_lost() -> None:
    cloud = {"spot": True, "other_instance_types": "c6i.large m7i.large"}
    (group,) = resources(cloud=cloud)["AutoScalingGroup"]
    policy = group["MixedInstancesPolicy"]

    assert "LaunchTemplate" not in group
    assert group["CapacityRebalance"] is True
    assert policy["InstancesDistribution"] == {
        "OnDemandAllocationStrategy": "prioritized", "OnDemandBaseCapacity": 1,
        "OnDemandPercentageAboveBaseCapacity": 0, "SpotAllocationStrategy": "price-capacity-optimized",
    }  # fmt: skip
    assert policy["LaunchTemplate"]["Overrides"] == [
        {"InstanceType": "c7i.large"}, {"InstanceType": "c6i.large"}, {"InstanceType": "m7i.large"},
    ]  # fmt: skip
    assert {"LaunchTemplateId", "Version"} <= policy["LaunchTemplate"]["LaunchTemplateSpecification"].keys()


def test_each_entry_of_the_schedule_is_a_scheduled_action() -> None:
    actions = resources(scaling={"schedule": OFFICE, "time_zone": "Asia/Seoul"})["ScheduledAction"]

    assert [(each["Recurrence"], each["MinSize"], each["TimeZone"]) for each in actions] == [
        ("0 8 * * 1,2,3,4,5", 4, "Asia/Seoul"), ("30 18 * * 5,6", 1, "Asia/Seoul"),
    ]  # fmt: skip
