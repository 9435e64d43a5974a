"""The folder of results: other files are never removed, and a report names machine and settings."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.demo.run import DemoOptions, run_demo
from rse_pf.extensions.experiments.load.run import run_swarm
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.results.result_folder import (
    commit_of,
)


def start_demo(out: Path) -> None:
    run_demo(DemoOptions(out=out), PlatformSettings())


def start_swarm(out: Path) -> None:
    run_swarm(LoadScenario(robots=1, seconds=1.0), PlatformSettings(), out=out)


@pytest.mark.parametrize(
    ("start", "other"),
    [
        (start_demo, "notes.txt"),
        (start_demo, "robot-photos"),
        (start_swarm, "map.png"),
        (start_swarm, "platform"),
    ],
)
def test_demo_and_swarm_refuse_a_folder_with_files_that_they_did_not_write(tmp_path, start, other):
    for name in ("events.jsonl", "report.json", other):
        (tmp_path / name).write_text("")

    with pytest.raises(UsageError, match="holds other files"):
        start(tmp_path)

    assert sorted(each.name for each in tmp_path.iterdir()) == sorted(["events.jsonl", "report.json", other])


def test_the_commit_of_a_checkout_is_named_and_whether_files_differ(tmp_path):
    def git(*words):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True, capture_output=True)

    assert commit_of(tmp_path) == ""
    git("init", "-q")
    (tmp_path / "a").write_text("one")
    git("add", "a")
    git("-c", "user.name=n", "-c", "user.email=e", "commit", "-q", "-m", "First")
    clean = commit_of(tmp_path)
    (tmp_path / "a").write_text("two")

    assert re.fullmatch("[0-9a-f]{40}", clean)
    assert commit_of(tmp_path) == f"{clean}+changes"
