"""Every setting is documented and read somewhere, and no other file contains configuration."""

from __future__ import annotations

import ast
import functools
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings, setting_rows, settings_page

GROUPS = set(PlatformSettings().to_dict())
KINDS = {type(getattr(PlatformSettings(), group)).__name__: group for group in GROUPS}
NAMES = [(row.group, row.name) for row in setting_rows()]
SPELLINGS = {"settings", "limits", "s"}
"""What a group is called where it is an argument on its own."""
OWNERS = Counter(name for _, name in NAMES)

WAITING: dict[str, set[str]] = {}
"""Settings whose readers are not written yet; the reader's author removes them here."""

LITERALS = re.compile(r"(?<![\w.])(?:8700|8765|8766|8767)(?![\w.])|\"/ws\"")


def unread(tree: Mapping[str, str]) -> set[tuple[str, str]]:
    """Return the settings, as ``(group, name)``, that no source of *tree* reads."""
    seen: set[tuple[str, str]] = set()
    for path, text in tree.items():
        if path != "rse_pf/config/settings.py":
            seen |= _read_in(text)
    return {
        (group, name)
        for group, name in NAMES
        if (group, name) not in seen and not (OWNERS[name] == 1 and ("", name) in seen)
    }


@functools.cache
def _read_in(text: str) -> frozenset[tuple[str, str]]:
    """Return the settings that one source reads; the group is empty where it does not say which."""
    seen: set[tuple[str, str]] = set()
    only = {kind for kind in KINDS if kind in text and re.search(rf"\b{kind}\b", text)}
    group = KINDS[only.pop()] if len(only) == 1 else ""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
            base = _last_name(node.value)
            if base in GROUPS:
                seen.add((base, node.attr))
            elif base in SPELLINGS:
                seen |= {(group, node.attr), ("", node.attr)}
    return frozenset(seen)


def _last_name(node: ast.expr) -> str:
    """Return ``b`` of ``b`` and of ``a.b``."""
    name = node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
    return name.lstrip("_")


def written_elsewhere(tree: Mapping[str, str]) -> list[str]:
    """Return where a port or a path of the platform is written outside the settings."""
    return [
        f"{path}: {found.group()} is a setting"
        for path, text in tree.items()
        if path != "rse_pf/config/settings.py"
        and path.startswith(("rse_pf/", "client_sdk/", "stacks/", "app.py"))
        for literal in _literals(ast.parse(text))
        for found in LITERALS.finditer(literal)
    ]


def _literals(tree: ast.Module) -> Iterator[str]:
    """Yield each number and each quoted string of the code; strings that stand alone are comments."""
    comments = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and id(node) not in comments:
            if isinstance(node.value, str):
                yield f'"{node.value}"'
            elif isinstance(node.value, int):
                yield str(node.value)


def test_every_setting_is_read_or_is_on_the_waiting_list(sources: Mapping[str, str]) -> None:
    waiting = {(group, name) for group, names in WAITING.items() for name in names}

    assert unread(sources) - waiting == set(), "no source reads these settings"
    assert waiting - unread(sources) == set(), "these are read: remove them from WAITING"


def test_an_unread_setting_is_caught(sources: Mapping[str, str]) -> None:
    text = sources["rse_pf/services/pnp.py"].replace("settings.max_correspondences", "5000")

    assert ("pnp", "max_correspondences") in unread({**sources, "rse_pf/services/pnp.py": text})


def test_the_same_name_in_another_group_does_not_count_as_read() -> None:
    read = unread({"rse_pf/x.py": "use(settings.serving.port)"})

    assert ("serving", "port") not in read
    assert ("local", "port") in read


def test_no_port_or_path_is_written_outside_the_settings(sources: Mapping[str, str]) -> None:
    assert written_elsewhere(sources) == []


@pytest.mark.parametrize("text", ["PORT = 8765", "url = '/ws'", "connect('127.0.0.1', 8700)"])
def test_a_port_or_path_written_elsewhere_is_caught(text: str) -> None:
    assert written_elsewhere({"rse_pf/local/box.py": text})


def test_the_page_of_settings_is_up_to_date(repository: Path) -> None:
    page = (repository / "docs" / "settings.md").read_text(encoding="utf-8")

    assert page == settings_page(), "run make docs"


def test_the_page_of_settings_names_every_setting_once() -> None:
    lines = settings_page().splitlines()

    for group, name in NAMES:
        start = lines.index(f"## {group}")
        rows = [line for line in lines[start:] if line.startswith(f"| `{name}` ")]
        assert rows, f"{group}.{name}"
    assert sum(line.startswith("| `") for line in lines) == len(NAMES)


def test_every_setting_says_what_it_is_for_and_who_chose_it() -> None:
    for row in setting_rows():
        assert len(row.doc) > 8, row.name
        assert row.source, row.name
        assert row.doc[0].islower() or row.doc.split()[0].isupper() or row.doc.startswith("RANSAC"), row.doc


def test_units_in_names_agree_with_the_unit_column() -> None:
    for row in setting_rows():
        for ending, unit in {"_s": "s", "_ms": "ms", "_bytes": "bytes", "_percent": "%"}.items():
            if row.name.endswith(ending) and not row.name.endswith("_per_s"):
                assert row.unit == unit, f"{row.group}.{row.name}"
