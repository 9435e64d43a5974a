"""docs/decisions: pages stay short, and each package is explained by exactly one of them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Set
from pathlib import Path

import pytest

MAX_WORDS = 800
MAX_ROW_LETTERS = 400
TOPS = (
    "benchmarks", "client_cpp", "client_sdk", "client_web", "examples", "fuzz", "lambda_pnp", "native",
    "ros_bridge", "rse_pf", "scripts", "stacks",
)  # fmt: skip
"""Folders of sources; the tests mirror them and are explained by no page."""

_HEAD = re.compile(r"^Packages: (.*)\.$", re.MULTILINE)


def broken_decision_laws(pages: Mapping[str, str], packages: Set[str], folders: Set[str]) -> list[str]:
    """Return what is wrong with the pages of decisions, one line each.

    Args:
        pages: Text of each page, by its file name.
        packages: Folders that exactly one page must name.
        folders: Folders that exist, which a page may name.
    """
    broken, pages_of = [], dict[str, list[str]]()
    for name, text in pages.items():
        words = len(text.split())
        if words > MAX_WORDS:
            broken.append(f"{name}: {words} words are more than {MAX_WORDS}")
        broken += [
            f"{name}: a row of {len(line)} letters begins with {line[:30]!r}"
            for line in text.splitlines()
            if line.startswith("|") and len(line) > MAX_ROW_LETTERS
        ]
        head = _HEAD.search(text)
        if head is None and name != "README.md":
            broken.append(f"{name}: there is no line 'Packages: ...'")
        for package in re.findall(r"`([^`]+)`", head[1]) if head else []:
            pages_of.setdefault(package, []).append(name)
    broken += [f"{package} is named by no page" for package in sorted(packages - pages_of.keys())]
    broken += [f"{package} does not exist" for package in sorted(pages_of.keys() - folders)]
    broken += [
        f"{package} is named by {' and '.join(names)}"
        for package, names in sorted(pages_of.items())
        if len(names) > 1
    ]
    return broken


def packages_to_explain(folders: Set[str]) -> set[str]:
    """Return the folders of *folders* that a page must name: the tops, and those in `rse_pf` and its backend.

    A page about a package is about the packages in it, too, unless another page names them.
    """
    parents = ("rse_pf", "rse_pf/backend")
    return {folder for folder in folders if folder in TOPS or folder.rpartition("/")[0] in parents}


@pytest.fixture(scope="module")
def folders(repository: Path) -> set[str]:
    """The folders at the top that hold sources, and every Python package below them."""
    inner = (path.parent for top in TOPS for path in (repository / top).rglob("__init__.py"))
    return {*TOPS, *(path.relative_to(repository).as_posix() for path in inner)}


def test_the_pages_are_short_and_explain_each_package_once(repository: Path, folders: set[str]) -> None:
    pages = {
        path.name: path.read_text(encoding="utf-8") for path in (repository / "docs/decisions").glob("*.md")
    }

    assert broken_decision_laws(pages, packages_to_explain(folders), folders) == []


def test_the_index_links_every_page(repository: Path) -> None:
    index = (repository / "docs/decisions/README.md").read_text(encoding="utf-8")
    names = {path.name for path in (repository / "docs/decisions").glob("*.md")} - {"README.md"}

    assert names - set(re.findall(r"\]\((\w+\.md)\)", index)) == set()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("Packages: `rse_pf/wire`.\n" + "word " * MAX_WORDS, "a.md: 802 words are more than 800"),
        ("Packages: `rse_pf/wire`.\n| " + "x" * MAX_ROW_LETTERS, "a.md: a row of 402 letters begins with"),
        ("# No head", "a.md: there is no line 'Packages: ...'"),
        ("Packages: `rse_pf/wire`, `rse_pf/attic`.", "rse_pf/attic does not exist"),
        ("Packages: `rse_pf/pnp`.", "rse_pf/pnp is named by b.md and a.md"),
        ("Packages: `rse_pf/pnp`.", "rse_pf/wire is named by no page"),
    ],
)
def test_the_law_of_decisions_catches(text: str, complaint: str) -> None:
    packages = {"rse_pf/pnp", "rse_pf/wire"}
    pages = {"b.md": "Packages: `rse_pf/pnp`.", "a.md": text}

    assert any(line.startswith(complaint) for line in broken_decision_laws(pages, packages, packages))
