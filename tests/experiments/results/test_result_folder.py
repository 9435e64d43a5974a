"""The folder of results: other files are never removed, and a report names machine and settings."""

from __future__ import annotations

import re
import subprocess

import pytest

from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.results.result_folder import (
    RUN_FILES,
    commit_of,
    fresh_folder,
)


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


def test_files_of_others_are_not_touched(tmp_path):
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(UsageError, match="holds other files"):
        fresh_folder(tmp_path, RUN_FILES)
    assert (tmp_path / "thesis.tex").exists()


def test_a_folder_named_like_a_result_is_not_removed_without_the_events_of_a_run(tmp_path):
    (tmp_path / "platform").mkdir()
    with pytest.raises(UsageError, match="holds other files"):
        fresh_folder(tmp_path, RUN_FILES)
    assert (tmp_path / "platform").is_dir()


@pytest.mark.parametrize("other", ["notes.txt", "mine", "platform"])
def test_results_beside_a_file_of_others_are_refused_and_nothing_is_removed(tmp_path, other):
    for name in ("events.jsonl", "report.json", "map.png"):
        (tmp_path / name).write_text("")
    for name in ("robot-1", "run"):
        (tmp_path / name).mkdir()
    (tmp_path / "run" / "events.jsonl").write_text("")
    if other == "notes.txt":
        (tmp_path / other).write_text("")
    else:
        (tmp_path / other).mkdir()
    before = sorted(tmp_path.rglob("*"))

    with pytest.raises(UsageError, match="holds other files"):
        fresh_folder(tmp_path, ["events.jsonl", "report.json", "map.png", "robot-*", "run"])

    assert sorted(tmp_path.rglob("*")) == before


def test_all_results_of_an_earlier_run_are_removed(tmp_path):
    out = tmp_path / "out"
    for part in ("kill", "stop"):
        (out / part).mkdir(parents=True)
        (out / part / "events.jsonl").write_text("")
    for name in ("report.json", "report.md", "robustness.png"):
        (out / name).write_text("old")

    fresh_folder(out, ("report.*", "robustness.png", "kill", "stop"))

    assert list(out.iterdir()) == []
