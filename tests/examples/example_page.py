"""The rows of docs/examples.md: each example with its sentence and its command."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

__all__ = ["PAGE", "REPOSITORY", "examples", "listed"]

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = REPOSITORY / "docs" / "examples.md"
_ROW = re.compile(r"^\| \[[^\]]+\]\(\.\./(examples/[^)]+)\) \| ([^|]+) \| `([^`|]+)` \|$", re.MULTILINE)


def examples(repository: Path = REPOSITORY) -> set[str]:
    """Return the paths of all examples: programs, services and notebooks."""
    folder = repository / "examples"
    found = [
        *folder.glob("robots/*.py"),
        *folder.glob("notebooks/*.ipynb"),
        *(path.parent for path in folder.glob("*/*/service.json")),
    ]
    return {path.relative_to(repository).as_posix() for path in found}


def listed(text: str) -> dict[str, tuple[str, list[str]]]:
    """Return path -> sentence and words of the command, of each row of the page."""
    return {path: (sentence, shlex.split(command)) for path, sentence, command in _ROW.findall(text)}
