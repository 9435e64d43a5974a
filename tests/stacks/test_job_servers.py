"""The group of job servers, as a template: Spot, empty at rest, reached by nobody, scaled by waiting jobs."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest

from rse_pf.config import PlatformSettings

pytestmark = pytest.mark.slow

Templates = dict[str, Any]


@pytest.fixture(scope="module")
def kept() -> dict[str, Templates]:
    return {}


@pytest.fixture
def templates(synthesise: Callable[[PlatformSettings], Templates], kept: dict[str, Templates]) -> Templates:
    if not kept:
        kept["jobs"] = synthesise(
            PlatformSettings.from_dict(
                {"cloud": {"job_servers": 5}, "serving": {"offer_jobs": True, "max_running_jobs": 0}}
            )
        )
    return kept["jobs"]


def of(template: Any, kind: str) -> dict[str, Any]:
    return {name: each["Properties"] for name, each in template["Resources"].items() if each["Type"] == kind}


def job_group(templates: Templates) -> dict[str, Any]:
    groups = of(templates["RsePf-Backend"], "AWS::AutoScaling::AutoScalingGroup").values()
    (found,) = (each for each in groups if each["AutoScalingGroupName"] == "rse-pf-jobs")
    return found


def test_the_group_is_empty_at_rest_and_of_spot_instances(templates: Templates) -> None:
    group = job_group(templates)

    assert (group["MinSize"], group["MaxSize"]) == ("0", "5")
    mixed = group["MixedInstancesPolicy"]
    assert mixed["InstancesDistribution"]["OnDemandPercentageAboveBaseCapacity"] == 0
    assert mixed["InstancesDistribution"]["OnDemandBaseCapacity"] == 0
    assert len(mixed["LaunchTemplate"]["Overrides"]) == 3
    assert "TargetGroupARNs" not in group
    assert {each["DefaultResult"] for each in group["LifecycleHookSpecificationList"]} == {
        "ABANDON",
        "CONTINUE",
    }


def test_waiting_jobs_start_job_servers_and_a_time_without_jobs_ends_them(templates: Templates) -> None:
    backend = templates["RsePf-Backend"]
    alarms = {each["AlarmName"]: each for each in of(backend, "AWS::CloudWatch::Alarm").values()}
    policies = of(backend, "AWS::AutoScaling::ScalingPolicy")

    for name, change in (("rse-pf/jobs-waiting", [1, 2]), ("rse-pf/jobs-idle", [-1])):
        alarm = alarms[name]
        metric = alarm["Metrics"][0]["MetricStat"]["Metric"]
        assert metric["Namespace"] == "RsePf"
        policy = policies[alarm["AlarmActions"][0]["Ref"]]
        assert [each["ScalingAdjustment"] for each in policy["StepAdjustments"]] == change
    assert alarms["rse-pf/jobs-idle"]["EvaluationPeriods"] == 10


def test_only_job_servers_reach_job_servers(templates: Templates) -> None:
    network = templates["RsePf-Network"]
    groups = of(network, "AWS::EC2::SecurityGroup")
    (name,) = (name for name, each in groups.items() if each["GroupDescription"].startswith("job servers"))
    here = {"Fn::GetAtt": [name, "GroupId"]}
    ingress = of(network, "AWS::EC2::SecurityGroupIngress").values()
    rules = [each for each in ingress if each["GroupId"] == here]

    assert "SecurityGroupIngress" not in groups[name]
    assert [each["SourceSecurityGroupId"] for each in rules] == [here]
    assert (rules[0]["FromPort"], rules[0]["ToPort"]) == (8790, 8889)


def test_a_job_server_is_told_its_role_and_its_group(templates: Templates) -> None:
    launch = of(templates["RsePf-Backend"], "AWS::EC2::LaunchTemplate")
    scripts = [str(each["LaunchTemplateData"]["UserData"]) for each in launch.values()]

    assert len(scripts) == 2
    (own,) = (each for each in scripts if "rse-pf-jobs-drain" in each)
    assert re.search(r"role\W+jobs", own)
