"""The documentation site: generated pages are complete, and a built site loads nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import client_sdk
from rse_pf.cli.main import VERBS
from rse_pf.server.metrics import Metrics, merge, render
from scripts.site.pages import cli_page, metrics_page, sdk_page

MAX_CPU_S = 60.0


def test_the_page_of_the_command_line_has_every_verb() -> None:
    page = cli_page()

    for verb in VERBS:
        assert f"\n## rse-pf {verb}\n" in page
        assert f"usage: rse-pf {verb} " in page
    assert "usage: rse-pf map merge " in page


def test_the_page_of_the_sdk_has_every_public_name() -> None:
    page = sdk_page()

    assert [name for name in client_sdk.__all__ if f"::: client_sdk.{name}\n" not in page] == []
    assert "::: rse_pf.auth.robot_key.RobotKey\n" in page


def test_the_page_of_metrics_has_what_a_server_gives(repository: Path) -> None:
    metrics = Metrics()
    metrics.count_answer("pnp", "ok", 0.01)
    metrics.gauges["robots"] = 1.0
    told = render(merge([metrics.snapshot()])).decode()
    page = metrics_page(repository)

    families = re.findall(r"^# TYPE (\w+) (\w+)$", told, re.MULTILINE)
    assert families
    for name, kind in families:
        assert f"| `{name.removesuffix('_total')}` | {kind} | " in page
    assert "`rse_pf_server_up`" in page


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mkdocs") is None, reason="run make site")
def test_the_site_is_built_in_a_minute_of_cpu_time_without_dead_links(repository: Path) -> None:
    before = os.times()
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"

    done = subprocess.run(
        ["sh", "scripts/site.sh"], cwd=repository, capture_output=True, text=True, check=False,
        env={**os.environ, "PATH": path, "http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"},
    )  # fmt: skip

    assert done.returncode == 0, done.stdout + done.stderr
    assert " 0 requests to other hosts" in done.stdout
    after = os.times()
    used_s = sum(after[2:4]) - sum(before[2:4])  # of this process's children
    assert used_s < MAX_CPU_S
