"""The scrape configurations on the pages are YAML, and name ports and files that the platform has."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings

yaml = pytest.importorskip("yaml", reason="no YAML parser is installed")

BLOCK = re.compile(r"^    scrape_configs:\n(?:    .*\n)+", re.MULTILINE)


def jobs(repository: Path, page: str) -> dict[str, Any]:
    """Return the jobs of all scrape configurations of a page, by name."""
    text = (repository / "docs" / page).read_text(encoding="utf-8")
    found = [yaml.safe_load(textwrap.dedent(block)) for block in BLOCK.findall(text)]
    return {job["job_name"]: job for each in found for job in each["scrape_configs"]}


def test_the_one_address_of_a_local_platform_is_the_default_port(repository: Path) -> None:
    job = jobs(repository, "local.md")["rse-pf-local"]

    port = PlatformSettings().local.metrics_port
    assert job["static_configs"] == [{"targets": [f"127.0.0.1:{port}"]}]
    assert job["authorization"] == {"type": "Bearer", "credentials_file": "STATE/control.token"}


def test_the_servers_are_found_by_the_file_beside_the_state(repository: Path) -> None:
    job = jobs(repository, "local.md")["rse-pf-servers"]

    assert job["file_sd_configs"][0]["files"] == ["STATE/prometheus_sd.json"]
    assert job["authorization"]["credentials_file"] == "STATE/control.token"


def test_a_server_of_the_cloud_is_asked_at_its_control_port(repository: Path) -> None:
    (job,) = jobs(repository, "operations.md").values()

    assert job["static_configs"] == [{"targets": [f"127.0.0.1:{PlatformSettings().serving.control_port}"]}]
