"""New servers join when they say so, and a deployment moves none: that is left to rse-pf cloud upgrade."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import VERSION_PARAMETER, ResourceNames
from rse_pf.scaling.boot_time import BOOT_LIMIT_S, BOOT_S
from rse_pf.scaling.health import CLOUD_INTERVAL_S, HEALTHY_CHECKS

NAMES = ResourceNames()
REPLACING = {"AutoScalingRollingUpdate", "AutoScalingReplacingUpdate"}


def group_of(templates: dict[str, Any]) -> dict[str, Any]:
    """Return the resource of the servers' group."""
    (found,) = (
        resource
        for template in templates.values()
        for resource in template["Resources"].values()
        if resource["Type"] == "AWS::AutoScaling::AutoScalingGroup"
        and resource["Properties"]["AutoScalingGroupName"] == NAMES.group
    )
    assert isinstance(found, dict)
    return found


def test_a_machine_that_says_nothing_never_joins(assembly: Any) -> None:
    (hook,) = group_of(assembly.templates)["Properties"]["LifecycleHookSpecificationList"]

    assert hook == {
        "LifecycleHookName": NAMES.launch_hook, "LifecycleTransition": "autoscaling:EC2_INSTANCE_LAUNCHING",
        "DefaultResult": "ABANDON", "HeartbeatTimeout": BOOT_LIMIT_S,
    }  # fmt: skip


def test_a_deployment_moves_no_server_and_keeps_the_version_that_they_run(assembly: Any) -> None:
    group = group_of(assembly.templates)

    assert not REPLACING & set(group.get("UpdatePolicy", {}))
    assert group["Properties"]["LaunchTemplate"]["Version"] == {"Ref": VERSION_PARAMETER}
    parameter = assembly.templates[NAMES.stack("Backend")]["Parameters"][VERSION_PARAMETER]
    assert parameter["Default"] == "1", "the first version of a new launch template"


def test_time_limits_of_a_launch_fit_one_measured_boot(assembly: Any) -> None:
    properties, settings = group_of(assembly.templates)["Properties"], assembly.settings

    (hook,) = properties["LifecycleHookSpecificationList"]
    assert hook["HeartbeatTimeout"] >= 2 * BOOT_S
    checks_s = HEALTHY_CHECKS * CLOUD_INTERVAL_S
    assert properties["HealthCheckGracePeriod"] >= 2 * checks_s, "it begins when the instance is in service"
    assert properties["HealthCheckGracePeriod"] == 90
    assert properties["DefaultInstanceWarmup"] == settings.scaling.warm_up_s


def test_a_server_may_fetch_the_package_of_the_version_before(assembly: Any) -> None:
    """An old launch template names an old package; only a digest in the template says what may run."""
    readable = [
        json.dumps(statement["Resource"])
        for policy in assembly.all("AWS::IAM::Policy")
        for statement in policy["PolicyDocument"]["Statement"]
        if statement["Action"] == "s3:GetObject"
    ]

    assert [each for each in readable if "/*.zip" in each]


@pytest.mark.slow
def test_a_fleet_of_a_fixed_size_has_a_template_that_can_be_updated(
    synthesise: Callable[[PlatformSettings], dict[str, Any]],
) -> None:
    fixed = PlatformSettings.from_dict({"scaling": {"min_servers": 3, "max_servers": 3}})

    group = group_of(synthesise(fixed))

    assert (group["Properties"]["MinSize"], group["Properties"]["MaxSize"]) == ("3", "3")
    rolling = REPLACING & set(group.get("UpdatePolicy", {}))
    assert not rolling, "MinInstancesInService would have to be below MaxSize"
