"""The links of pages at the root lead to files; mkdocs checks those of the site when it is built."""

from __future__ import annotations

import re
from pathlib import Path

import pytest


@pytest.mark.parametrize("page", ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"])
def test_the_links_of_a_page_at_the_root_lead_to_files(page: str, repository: Path) -> None:
    links = re.findall(r"\]\(([^)\s#]+)", (repository / page).read_text(encoding="utf-8"))

    assert [link for link in links if "://" not in link and not (repository / link).exists()] == []
