"""docs/security.md names all threats, and only files and tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

THREATS = [f"T{number}" for number in range(1, 25)]


def rows(page: str) -> dict[str, str]:
    """Return the rows of the table of threats by their number."""
    return {found[1]: found[0] for found in re.finditer(r"^\| (T\d+) \|.*$", page, re.M)}


def broken(page: str, repository: Path) -> list[str]:
    """Return what is wrong with *page*: threats without a row, rows without proof, names of nothing."""
    table = rows(page)
    wrong = [f"{threat} has no row" for threat in THREATS if threat not in table]
    for threat, row in table.items():
        named = re.findall(r"`([\w./-]+\.(?:py|sh|txt|js|hpp))(?:::(\w+))?`", row)
        if not any(test for _, test in named):
            wrong.append(f"{threat} names no test")
        if not any(not test for _, test in named):
            wrong.append(f"{threat} says nowhere where it is held")
    for file, test in re.findall(r"`([\w./-]+\.(?:py|sh|txt|js|hpp))(?:::(\w+))?`", page):
        path = repository / file
        if not path.is_file():
            wrong.append(f"there is no {file}")
        elif test and not re.search(rf"^(?:async )?def {test}\b", path.read_text(encoding="utf-8"), re.M):
            wrong.append(f"{file} has no {test}")
    return wrong


def test_every_threat_is_held_somewhere_and_shown_by_a_test(repository: Path) -> None:
    assert broken((repository / "docs/security.md").read_text(encoding="utf-8"), repository) == []


def test_a_page_that_lies_is_seen(repository: Path) -> None:
    page = (repository / "docs/security.md").read_text(encoding="utf-8")
    lies = page.replace("rse_pf/auth/tokens.py", "rse_pf/author.py").replace(
        "test_hostile_lua_stays_in_its_sandbox", "test_gone"
    )
    lies = re.sub(r"^\| T24 .*\n", "", lies, flags=re.M)

    assert set(broken(lies, repository)) == {
        "T24 has no row",
        "there is no rse_pf/author.py",
        "tests/system/server/test_sandbox.py has no test_gone",
    }
