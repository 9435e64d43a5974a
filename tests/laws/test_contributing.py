"""Commands of make, files and settings that the pages name exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rse_pf.config import setting_rows
from scripts.site.blocks import pages

PAGES = (
    "CONTRIBUTING.md", *(name for name in pages(Path(__file__).parents[2]) if name != "docs/settings.md"),
)  # fmt: skip
"""CHANGELOG.md is left out: it names what is gone; settings.md is generated."""
FOLDERS = "rse_pf|tests|docs|client_sdk|lambda_pnp|stacks|benchmarks|scripts|fuzz|locks|examples"
FILE = re.compile(rf"`((?:{FOLDERS})/[\w./-]+)`")
LINK = re.compile(r"\]\(([^)#:]+)\)")
SETTING = re.compile(r"`([a-z]+)\.(?!py`)([a-z][a-z0-9_]+)`")


def missing(text: str, repository: Path, folder: str = "") -> list[str]:
    """Return the commands of make, files, links and settings in *text* that do not exist.

    Args:
        text: A page.
        repository: Root of the checkout.
        folder: Folder of the page, to which its links are relative.
    """
    verbs = set(re.findall(r"^([a-z-]+):", (repository / "Makefile").read_text(encoding="utf-8"), re.M))
    wanted = re.findall(r"\bmake ([a-z]+)(?=`|\s+#|,)", text)
    settings = {(row.group, row.name) for row in setting_rows()}
    groups = {group for group, _ in settings}
    return [
        *(verb for verb in wanted if verb not in verbs),
        *(path for path in FILE.findall(text) if "NAME" not in path and not (repository / path).exists()),
        *(path for path in LINK.findall(text) if not (repository / folder / path).exists()),
        *(
            f"{group}.{name}"
            for group, name in SETTING.findall(text)
            if group in groups and (group, name) not in settings
        ),
    ]


@pytest.mark.parametrize("page", PAGES)
def test_every_command_file_and_setting_that_a_page_names_exists(repository: Path, page: str) -> None:
    text = (repository / page).read_text(encoding="utf-8")

    assert missing(text, repository, page.rpartition("/")[0]) == []


def test_every_page_is_checked(repository: Path) -> None:
    found = {path.relative_to(repository).as_posix() for path in (repository / "docs").rglob("*.md")}

    assert {each for each in found - set(PAGES) if not each.endswith("/report.md")} == {"docs/settings.md"}


def test_a_command_file_link_or_setting_that_does_not_exist_is_noticed(repository: Path) -> None:
    text = "run `make coffee`, see `docs/coffee.md` and [tea](tea.md), set `serving.sugar`"

    assert missing(text, repository) == ["coffee", "docs/coffee.md", "tea.md", "serving.sugar"]
