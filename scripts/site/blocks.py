"""The code blocks of the pages: which a test executes, and which are marked with the reason why it does not.

A block is a command block (no language, or ``sh``), or code (python, json, yaml, ...); ``text`` is no code.
A comment before a block marks it: ``<!-- needs an account -->``; a paragraph before it that contains the
words marks it as well.  ``<!-- file: NAME -->`` names the file in which a program is saved.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

__all__ = [
    "MARKS",
    "RUN_BY_OTHERS",
    "Block",
    "all_blocks",
    "is_executed",
    "pages",
    "read_blocks",
]

MARKS = (
    "needs an account", "needs a device", "needs a recording", "takes long", "part of a program",
)  # fmt: skip
"""Why a block is not executed."""
RUN_BY_OTHERS = {"docs/operations.md": "tests/stacks/test_operations.py"}
"""Page -> test that executes its blocks without a mark; `tests/docs/test_run_pages.py` runs the others."""
NO_CODE = ("text",)

_FENCE = re.compile(r"^(`{3,}|~{3,})(\w*)[^\n]*\n(.*?)^\1[ \t]*$", re.DOTALL | re.MULTILINE)
_INDENTED = re.compile(r"(?:^[ \t]*\n)((?:^    (?![-*] |\d+\. )[^\n]*\n)+)", re.MULTILINE)
_COMMENT = re.compile(r"<!-- ([^>]*?) -->")
_GENERATED = ("docs/settings.md",)


@dataclass(frozen=True, slots=True, kw_only=True)
class Block:
    """One block: *mark* is why it is not executed, or empty; *file* is where it is saved, or empty."""

    page: str
    line: int
    language: str
    text: str
    mark: str = ""
    file: str = ""


def pages(root: Path) -> list[str]:
    """Return README.md and all pages of ``docs``, by path, without the reports of experiments."""
    paths = [path.relative_to(root).as_posix() for path in sorted((root / "docs").rglob("*.md"))]
    return ["README.md", *(page for page in paths if not page.endswith("/report.md"))]


def read_blocks(page: str, text: str) -> Iterator[Block]:
    """Yield the blocks of a page that hold code, fenced or indented, in their order."""
    spans: list[tuple[int, str, str]] = []
    for match in _FENCE.finditer(text):
        spans.append((match.start(), match[2], match[3]))
    without = _FENCE.sub(lambda found: re.sub(r"[^\n]", "x", found[0]), text)
    for found in _INDENTED.finditer(without):
        body = "".join(line[4:] + "\n" for line in found[1].splitlines())
        spans.append((found.start(1), _language_of(body), body))
    for start, language, body in sorted(spans):
        if language in NO_CODE:
            continue
        before = re.split(r"\n[ \t]*\n|```", text[:start].rstrip("\n"))[-1].lower()
        comments = _COMMENT.findall(before)
        file_names = [comment.removeprefix("file: ") for comment in comments if comment.startswith("file: ")]
        mark = next((mark for mark in MARKS if mark in before), "")
        if file_names:
            # The words were compared in small letters; names are not.
            file_names = [re.findall(r"<!-- file: (\S+) -->", text[:start])[-1]]
        yield Block(
            page=page, line=text.count("\n", 0, start) + 1, language=language, text=body, mark=mark,
            file=file_names[0] if file_names else "",
        )  # fmt: skip


def _language_of(body: str) -> str:
    first = body.lstrip().partition("\n")[0]
    if re.match(r"[a-z_]+:", first):
        return "yaml"
    return "python" if re.match(r"(async |import |from |with |def )", first) else ""


def is_executed(block: Block) -> bool:
    """Return whether a test executes the block: a program or commands, without a mark."""
    return not block.mark and block.language not in ("json", "yaml")


def all_blocks(root: Path) -> list[Block]:
    """Return the blocks of all pages that are written by hand."""
    return [
        block
        for page in pages(root)
        if page not in _GENERATED
        for block in read_blocks(page, (root / page).read_text(encoding="utf-8"))
    ]
