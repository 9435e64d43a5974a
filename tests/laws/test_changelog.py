"""CHANGELOG.md says the new name of everything public that was renamed."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path

KINDS = ("settings", "options", "metrics", "classes", "members", "imports")
"""Of ``renamed.json``; its words are vocabulary, not names."""


def missing_rows(changelog: str, renamed: Mapping[str, Mapping[str, str | None]]) -> list[str]:
    """Return the names in *renamed* that no row of *changelog* has with their new name."""
    rows = dict(re.findall(r"^\| `([^`]+)` \| (.+) \|$", changelog, re.M))
    return [
        old
        for kind in KINDS
        for old, new in renamed[kind].items()
        if (f"`{new}`" not in rows.get(old, "") if new else old not in rows)
    ]


def test_the_changelog_has_a_row_for_every_name_that_changed(repository: Path) -> None:
    renamed = json.loads((repository / "rse_pf" / "config" / "renamed.json").read_text(encoding="utf-8"))
    changelog = (repository / "CHANGELOG.md").read_text(encoding="utf-8")

    assert missing_rows(changelog, renamed) == []


def test_a_name_without_a_row_or_with_another_new_name_is_noticed() -> None:
    renamed = {kind: {} for kind in KINDS} | {"settings": {"a.b": "a.c", "a.d": None, "a.e": "a.f"}}

    assert missing_rows("| `a.b` | `a.x` |\n| `a.e` | `a.f` |\n", renamed) == ["a.b", "a.d"]
