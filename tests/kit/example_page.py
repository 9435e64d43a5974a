"""The rows of docs/examples.md: each example with its sentence and its command."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

__all__ = ["PAGE", "REPOSITORY", "listed"]

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = REPOSITORY / "docs" / "examples.md"
_ROW = re.compile(r"^\| \[[^\]]+\]\(\.\./(examples/[^)]+)\) \| ([^|]+) \| `([^`|]+)` \|$", re.MULTILINE)


def listed(text: str) -> dict[str, tuple[str, list[str]]]:
    """Return path -> sentence and words of the command, of each row of the page."""
    return {path: (sentence, shlex.split(command)) for path, sentence, command in _ROW.findall(text)}
