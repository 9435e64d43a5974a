"""The pages that are written by hand."""

from __future__ import annotations

from pathlib import Path

__all__ = ["PAGES", "ROOT"]

ROOT = Path(__file__).parents[2]
_GENERATED = ("docs/settings.md",)
_REPORT = "report.md"
"""The name of the pages that experiments write."""
PAGES = (
    "README.md",
    *(
        name
        for path in sorted((ROOT / "docs").rglob("*.md"))
        if (name := path.relative_to(ROOT).as_posix()) not in _GENERATED and path.name != _REPORT
    ),
)
