"""docs/services.md as a new user would follow it: every command of its blocks, in an empty folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[3] / "docs" / "services.md"
pytestmark = [pytest.mark.system, pytest.mark.slow]


def commands() -> list[list[str]]:
    """Return the words of each command in the fenced blocks."""
    blocks = re.findall(r"^```\n(.*?)^```", DOCS.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [line.split() for block in blocks for line in block.splitlines() if line]


def rse_pf(words: list[str], folder: Path) -> str:
    """Run one command; return what it printed."""
    done = subprocess.run(
        [sys.executable, "-m", "rse_pf.cli.main", *words], cwd=folder, capture_output=True, text=True,
        timeout=60, check=False, env={**os.environ, "PYTHONPATH": str(DOCS.parents[1])},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_every_command_of_the_page_works_in_an_empty_folder(tmp_path: Path) -> None:
    found = commands()
    assert [words[:3] for words in found[:2]] == [["rse-pf", "service", "new"], ["rse-pf", "service", "test"]]

    printed = [rse_pf(words[1:], tmp_path) for words in found]

    assert "1 of 1 recorded request as expected" in printed[1]
    assert '"centroid": [1.0, 1.0, 1.0]' in printed[2]
    assert "centroid" in printed[-1], "what was installed is not listed"
