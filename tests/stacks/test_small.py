"""The small profile: one zone for servers and endpoints, two for the load balancer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from rse_pf.config import PlatformSettings

SMALL = PlatformSettings.from_dict({"cloud": {"profile": "small"}})


@pytest.mark.slow
def test_servers_and_endpoints_are_in_one_zone_and_the_load_balancer_in_two(
    synthesise: Callable[[PlatformSettings], dict[str, Any]],
) -> None:
    resources = [
        each for template in synthesise(SMALL).values() for each in template["Resources"].values()
    ]  # fmt: skip

    def all_of(kind: str) -> list[dict[str, Any]]:
        return [each["Properties"] for each in resources if each["Type"] == kind]

    (group,) = all_of("AWS::AutoScaling::AutoScalingGroup")
    (balancer,) = all_of("AWS::ElasticLoadBalancingV2::LoadBalancer")
    endpoints = [
        each for each in all_of("AWS::EC2::VPCEndpoint") if each.get("VpcEndpointType") == "Interface"
    ]  # fmt: skip
    assert (group["MinSize"], len(group["VPCZoneIdentifier"])) == ("1", 1)
    assert {len(each["SubnetIds"]) for each in endpoints} == {1}
    assert len(endpoints) == 2
    assert len(balancer["Subnets"]) == 2
