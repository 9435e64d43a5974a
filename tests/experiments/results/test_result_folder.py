"""The folder of results: other files are never removed, and a report names machine and settings."""

from __future__ import annotations

import re
import subprocess

from rse_pf.extensions.experiments.results.result_folder import (
    commit_of,
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
