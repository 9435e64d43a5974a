"""The corners of the settings: each synthesises, and neither cdk-nag, cfn-lint nor moto object."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import STACKS, ResourceNames
from tests.stacks.conftest import Assembly, read_assembly, synthesise_into
from tests.stacks.test_moto import created_on_moto
from tests.stacks.test_templates import NEEDLESS

CORNERS: dict[str, Mapping[str, Mapping[str, Any]]] = {
    "lab": {"cloud": {"name": "lab", "bootstrap_qualifier": "lab1"}},
    "team-2": {"cloud": {"name": "team-2", "allow_insecure": True, "canary": False, "idle_action": "none"}},
    "small": {"cloud": {"profile": "small"}},
    "spot": {"cloud": {"spot": True, "other_instance_types": "c6i.large m7i.large"}},
    "warm": {"cloud": {"warm_servers": 2}},
    "no data": {"data": {"enabled": False}},
    "min = max": {"scaling": {"min_servers": 3, "max_servers": 3}},
    "one server": {"scaling": {"min_servers": 1, "max_servers": 1}},
    "parks and resumes": {
        "cloud": {"idle_action": "park"},
        "scaling": {"schedule": "weekdays 08:00 min 4; weekdays 18:00 min 1"},
    },
    "budget": {"cloud": {"budget_per_month": 300.0}},
}
EXPECTED_WARNING = "Annotation::rse-pf:allow-insecure"


@pytest.fixture(params=CORNERS)
def corner(request: pytest.FixtureRequest, tmp_path: Path, repository: Path) -> Assembly:
    """The platform with settings at one corner."""
    return synthesise(PlatformSettings.from_dict(CORNERS[request.param]), tmp_path, repository)


def synthesise(settings: PlatformSettings, folder: Path, repository: Path) -> Assembly:
    """Return the assembly of *settings*; it takes about ten seconds."""
    if shutil.which("node") is None:
        pytest.skip("the CDK needs Node.js")
    pytest.importorskip("aws_cdk", reason="run make setup")
    pytest.importorskip("cdk_nag", reason="run make setup")
    synthesise_into(settings, folder, repository)
    return read_assembly(settings, folder)


@pytest.mark.slow
def test_a_corner_of_the_settings_can_be_deployed(corner: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    api = pytest.importorskip("cfnlint.api", reason="cfn-lint is not installed")
    names = ResourceNames(corner.settings.cloud.name)

    assert [each["ruleName"] for each in corner.findings] == [EXPECTED_WARNING]
    assert set(corner.templates) == {names.stack(box) for box in STACKS}
    for template in corner.templates.values():
        found = api.lint(json.dumps(template), regions=[corner.settings.cloud.region])
        assert [str(each) for each in found if each.rule.id not in NEEDLESS] == []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with created_on_moto(corner, monkeypatch) as created:
            assert created.statuses == dict.fromkeys(STACKS, "CREATE_COMPLETE")


@pytest.mark.slow
def test_two_deployments_of_one_account_share_no_name(tmp_path: Path, repository: Path) -> None:
    found = []
    for name in ("", "lab"):
        settings = PlatformSettings.from_dict({"cloud": {"name": name}})
        (tmp_path / f"of-{name}").mkdir()
        found.append(fixed_names(synthesise(settings, tmp_path / f"of-{name}", repository)))

    assert len(found[0]) > 20
    assert found[0] & found[1] == set()


def fixed_names(assembly: Assembly) -> set[tuple[str, str]]:
    """Return type and name of each resource that has a name in the template."""
    return {
        (resource["Type"], value)
        for template in assembly.templates.values()
        for resource in template["Resources"].values()
        for key, value in resource.get("Properties", {}).items()
        if key in NAME_PROPERTIES and isinstance(value, str)
    }


NAME_PROPERTIES = (
    "Name", "AlarmName", "AutoScalingGroupName", "FunctionName", "DashboardName", "LifecycleHookName",
    "TopicName", "BucketName", "RoleName", "LogGroupName", "BudgetName",
)  # fmt: skip
