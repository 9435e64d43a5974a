"""The bill of materials names the JavaScript of others in the page, with version, licence and digests."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest


def digests_in(bill: dict[str, Any]) -> dict[str, str]:
    return {
        file["name"]: file["hashes"][0]["content"]
        for each in bill["components"]
        for file in each.get("components", ())
    }


@pytest.mark.slow
def test_the_bills_are_valid_and_contain_the_vendored_packages(repository: Path) -> None:
    validation = pytest.importorskip("cyclonedx.validation.json", reason="run make setup")
    schema = pytest.importorskip("cyclonedx.schema")
    if shutil.which("make") is None:
        pytest.skip("there is no make")
    subprocess.run(["make", "sbom"], cwd=repository, check=True, timeout=240, capture_output=True)

    for name in ("sbom.json", "sbom-boot.json"):
        text = (repository / "build" / name).read_text("utf-8")
        validator = validation.JsonStrictValidator(schema.SchemaVersion.V1_6)
        assert validator.validate_str(text) is None
        assert len(digests_in(json.loads(text))) == 6
