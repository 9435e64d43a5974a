"""What `rse-pf cloud cost` counts is what the templates hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.extensions.costs.bill import bill_of
from rse_pf.extensions.costs.prices import load_prices

Assembly = Any


def alarm_metrics(assembly: Assembly, stack: str) -> int:
    """Return the metrics in the alarms of a stack; each is paid for."""
    return sum(
        len([query for query in resource["Properties"]["Metrics"] if "MetricStat" in query])
        for resource in assembly.templates[f"RsePf-{stack}"]["Resources"].values()
        if resource["Type"] == "AWS::CloudWatch::Alarm"
    )


def volume_gb(assembly: Assembly) -> int:
    template = assembly.one("AWS::EC2::LaunchTemplate")["LaunchTemplateData"]
    size: int = template["BlockDeviceMappings"][0]["Ebs"]["VolumeSize"]
    return size * int(assembly.one("AWS::AutoScaling::AutoScalingGroup")["MinSize"])


COUNTED: dict[str, Callable[[Assembly], float]] = {
    "alarms for the operator": lambda it: alarm_metrics(it, "Observability"),
    "alarms that scale": lambda it: alarm_metrics(it, "Backend"),
    "web ACL": lambda it: len(it.all("AWS::WAFv2::WebACL")),
    "its rules": lambda it: len(it.one("AWS::WAFv2::WebACL")["Rules"]),
    "load balancer": lambda it: 730 * len(it.all("AWS::ElasticLoadBalancingV2::LoadBalancer")),
    "its public addresses, in two zones": lambda it: (
        730 * len(it.one("AWS::ElasticLoadBalancingV2::LoadBalancer")["Subnets"])
    ),
    "secrets": lambda it: len(it.all("AWS::SecretsManager::Secret")),
    "volumes": volume_gb,
}
"""A line of the bill to what the templates have of it."""


@pytest.mark.parametrize("what", COUNTED)
def test_a_line_of_the_bill_counts_what_the_templates_have(assembly: Assembly, what: str) -> None:
    bill = bill_of(assembly.settings, load_prices())
    lines = [each for each in bill.lines if each.what.removesuffix(", of 10 s") == what]

    assert sum(line.count for line in lines) == COUNTED[what](assembly) > 0


def test_the_bill_of_the_small_profile_has_the_endpoints_of_one_zone() -> None:
    bill = bill_of(PlatformSettings.from_dict({"cloud": {"profile": "small"}}), load_prices())

    assert sum(line.count for line in bill.lines if line.what.startswith("endpoint of")) == 2 * 730


def test_nothing_that_is_paid_by_the_hour_is_missing_from_the_bill(assembly: Assembly) -> None:
    by_the_hour = {
        "AWS::EC2::NatGateway", "AWS::EC2::EIP", "AWS::RDS::DBInstance", "AWS::EFS::FileSystem",
        "AWS::ElastiCache::CacheCluster", "AWS::DynamoDB::Table", "AWS::EC2::Instance",
    }  # fmt: skip
    kinds = {
        each["Type"] for template in assembly.templates.values() for each in template["Resources"].values()
    }

    assert not kinds & by_the_hour
