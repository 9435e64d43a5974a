"""The bill of materials names the JavaScript of others in the page, with version, licence and digests."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from rse_pf.fleet_page.static_files import vendored

BILL: dict[str, Any] = {
    "bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1,
    "metadata": {"component": {"bom-ref": "root", "type": "application", "name": "rse-pf"}},
    "components": [{"bom-ref": "z", "type": "library", "name": "numpy", "version": "2"}],
    "dependencies": [{"ref": "root", "dependsOn": ["z"]}, {"ref": "z"}],
}  # fmt: skip


@pytest.fixture(scope="module")
def script(repository: Path) -> Any:
    spec = importlib.util.spec_from_file_location("sbom_script", repository / "scripts" / "sbom.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def digests_in(bill: dict[str, Any]) -> dict[str, str]:
    return {
        file["name"]: file["hashes"][0]["content"]
        for each in bill["components"]
        for file in each.get("components", ())
    }


def test_each_vendored_package_is_a_component_with_the_digests_of_its_files(
    script: Any, repository: Path
) -> None:
    bill = script.with_vendored(BILL, vendored())

    assert {
        (each["name"], each["version"], each["licenses"][0]["license"]["id"], each["purl"])
        for each in bill["components"]
        if "purl" in each
    } == {
        ("three", "0.187.0", "MIT", "pkg:npm/three@0.187.0"),
        ("uplot", "1.6.32", "MIT", "pkg:npm/uplot@1.6.32"),
    }
    told = digests_in(bill)
    assert len(told) == 6
    for name, digest in told.items():
        assert hashlib.sha256((repository / name).read_bytes()).hexdigest() == digest


def test_what_was_there_stays_and_a_second_run_changes_nothing(script: Any) -> None:
    bill = script.with_vendored(BILL, vendored())

    assert BILL["components"][0] in bill["components"]
    root = next(each for each in bill["dependencies"] if each["ref"] == "root")
    assert root["dependsOn"] == ["pkg:npm/three@0.187.0", "pkg:npm/uplot@1.6.32", "z"]
    assert script.with_vendored(bill, vendored()) == bill


@pytest.mark.slow
def test_the_bills_are_valid_and_contain_the_vendored_packages(repository: Path) -> None:
    validation = pytest.importorskip("cyclonedx.validation.json", reason="the security extra is missing")
    schema = pytest.importorskip("cyclonedx.schema")
    if shutil.which("make") is None:
        pytest.skip("there is no make")
    subprocess.run(["make", "sbom"], cwd=repository, check=True, timeout=240, capture_output=True)

    for name in ("sbom.json", "sbom-boot.json"):
        text = (repository / "build" / name).read_text("utf-8")
        validator = validation.JsonStrictValidator(schema.SchemaVersion.V1_6)
        assert validator.validate_str(text) is None
        assert len(digests_in(json.loads(text))) == 6
