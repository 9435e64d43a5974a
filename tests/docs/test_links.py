"""Every link of README, CONTRIBUTING and the pages leads to a file, a heading, or a well-formed address."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from scripts.site.blocks import pages

LINK = re.compile(r"(?<!\\)\]\(<?([^)\s>]+)>?(?: \"[^\"]*\")?\)")
FENCED = re.compile(r"^(`{3,}|~{3,}).*?^\1[ \t]*$", re.DOTALL | re.MULTILINE)
HEADING = re.compile(r"^#{1,6} +(.+?) *#*$", re.MULTILINE)


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as the site and code hosts make them."""
    found: set[str] = set()
    for heading in HEADING.findall(FENCED.sub("", text)):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        anchor = re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", plain).strip())
        number = 1
        while (each := anchor if number == 1 else f"{anchor}-{number - 1}") in found:
            number += 1
        found.add(each)
    return found


def dead_links(texts: Mapping[str, str], root: Path) -> Iterator[str]:
    """Yield the links of *texts* (path to page) that lead nowhere, one line each."""
    for page, text in texts.items():
        for link in LINK.findall(FENCED.sub("", text)):
            address = urlsplit(link)
            if address.scheme or address.netloc:
                if (
                    address.scheme not in ("https", "http", "mailto")
                    or "." not in address.netloc + address.path
                ):
                    yield f"{page}: {link} is no address"
                continue
            target = (root / page).parent / address.path if address.path else root / page
            name = target.resolve().relative_to(root.resolve()).as_posix()
            if not target.exists():
                yield f"{page}: {link} does not exist"
            elif address.fragment and name.endswith(".md"):
                there = texts[name] if name in texts else target.read_text(encoding="utf-8")
                if address.fragment not in anchors(there):
                    yield f"{page}: {link}: no such heading"


@pytest.fixture(scope="module")
def texts(repository: Path) -> Mapping[str, str]:
    """Every page by its path."""
    names = [*pages(repository), "CONTRIBUTING.md", "CHANGELOG.md"]
    return {name: (repository / name).read_text(encoding="utf-8") for name in names}


def test_no_link_is_dead(texts: Mapping[str, str], repository: Path) -> None:
    assert list(dead_links(texts, repository)) == []
