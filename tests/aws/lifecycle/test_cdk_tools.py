"""The pinned command line builds and deploys, and its failures are one line and a hint."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.aws.lifecycle.cdk_tools import CdkTools
from rse_pf.config import PlatformSettings, resource_names

SETTINGS = PlatformSettings().replace(cloud={"bootstrap_qualifier": "lab1"})


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout whose CDK writes down what it is called with."""
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "cdk.sh").write_text('echo "$@" >> called\nexit "$(cat code)"\n')
    (tmp_path / "code").write_text("0")
    return tmp_path


def test_the_cdk_gets_one_stack_the_region_and_the_qualifier(checkout: Path) -> None:
    tools = CdkTools(checkout, SETTINGS, "123456789012")

    tools.bootstrap()
    tools.deploy("RsePf-Data")

    first, second = (checkout / "called").read_text().splitlines()
    options = "--qualifier lab1 --toolkit-stack-name CDKToolkit-lab1"
    assert first == f"bootstrap aws://123456789012/ap-northeast-2 {options}"
    assert second.startswith("deploy RsePf-Data --exclusively --require-approval never")


def test_the_qualifier_of_the_cdk_has_the_stack_of_the_cdk_and_any_other_one_of_its_own() -> None:
    assert resource_names.toolkit_stack("hnb659fds") == "CDKToolkit"
    assert resource_names.toolkit_stack("lab1") == "CDKToolkit-lab1"
