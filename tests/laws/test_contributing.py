"""What the pages for contributors name exists."""

from __future__ import annotations

import re
from pathlib import Path


def missing(text: str, repository: Path) -> list[str]:
    """Return the verbs of make and the files that *text* names and nobody has."""
    verbs = set(re.findall(r"^([a-z-]+):", (repository / "Makefile").read_text(encoding="utf-8"), re.M))
    named = re.findall(r"`((?:rse_pf|tests|docs|client_sdk|benchmarks)/[\w./-]+)`", text)
    wanted = re.findall(r"\bmake ([a-z]+)(?=`|\s+#|,)", text)
    return [verb for verb in wanted if verb not in verbs] + [
        path for path in named if "NAME" not in path and not (repository / path).exists()
    ]


def test_every_verb_and_file_that_the_pages_name_exists(repository: Path) -> None:
    for page in ("CONTRIBUTING.md", "CHANGELOG.md", "docs/protocol.md"):
        assert missing((repository / page).read_text(encoding="utf-8"), repository) == [], page


def test_a_verb_or_file_that_is_gone_is_noticed(repository: Path) -> None:
    assert missing("run `make coffee`, see `docs/coffee.md`", repository) == ["coffee", "docs/coffee.md"]
