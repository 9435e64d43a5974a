"""docs/architecture.md: the picture is current, and the ways name files and functions that exist."""

from __future__ import annotations

import ast
import importlib.util
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

WAYS = ("The way of a frame", "The way of a keyframe", "The way of a setting", "The way of a token")
LIVE_MAPS_BESIDE = frozenset({
    "children.py", "garbage.py", "subscriptions.py", "owner/context.py", "owner/keyframe_objects.py",
    "owner/lease.py", "owner/link_security.py", "owner/process.py", "owner/publisher.py", "owner/replies.py",
    "owner/threads.py", "owner/whole_fit.py",
})  # fmt: skip
"""Files of live maps that no keyframe passes: processes, leases, keys, versions, other replies; and the one
file that a correction passes besides, as the page says."""
ROW = re.compile(r"^\| \d+ \| `([\w./-]+)` \| ([^|]*) \|", re.M)


@pytest.fixture(scope="module")
def script(repository: Path) -> Any:
    """The module scripts/architecture.py."""
    path = repository / "scripts" / "architecture.py"
    spec = importlib.util.spec_from_file_location("architecture", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    """The page."""
    return (repository / "docs" / "architecture.md").read_text(encoding="utf-8")


def steps(page: str, way: str) -> list[tuple[str, list[str]]]:
    """Return the file and the functions of each step of a way."""
    section = page.partition(f"## {way}\n")[2].partition("\n## ")[0]
    return [(file, re.findall(r"`([\w.]+)`", cell)) for file, cell in ROW.findall(section)]


def broken_steps(found: list[tuple[str, list[str]]], repository: Path) -> list[str]:
    """Return what is wrong with a way: files twice, and files or functions that do not exist."""
    files = [file for file, _ in found]
    broken = [f"{file} is passed twice" for file in sorted(set(files)) if files.count(file) > 1]
    for file, functions in found:
        if not (repository / file).is_file():
            broken.append(f"there is no {file}")
            continue
        known = defined((repository / file).read_text(encoding="utf-8"))
        broken += [f"{file} has no {function}" for function in functions if function not in known]
        if not functions:
            broken.append(f"{file} names no function")
    return broken


def defined(text: str) -> set[str]:
    """Return the classes, functions and methods that a module defines, methods with their class."""
    tree = ast.parse(text)
    functions = ast.FunctionDef | ast.AsyncFunctionDef
    found = {node.name for node in tree.body if isinstance(node, functions)}
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            found.add(node.name)
            found |= {f"{node.name}.{each.name}" for each in node.body if isinstance(each, functions)}
    return found


def test_the_picture_is_drawn_from_todays_sources(script: Any, repository: Path) -> None:
    committed = (repository / "docs" / "images" / "architecture.svg").read_text(encoding="utf-8")

    assert committed == script.draw(script.read_sources(repository)), "run make docs"


def test_a_new_import_changes_the_picture(script: Any) -> None:
    sources = {"rse_pf/wire/codec.py": '"""Bytes."""', "rse_pf/service.py": '"""Services."""'}
    importing = {**sources, "rse_pf/service.py": '"""Services."""\nimport rse_pf.wire.codec'}

    assert script.draw(sources).count("<path class") == 0
    assert script.draw(importing).count("<path class") == 1


def test_an_import_that_a_chain_of_others_implies_is_not_drawn(script: Any) -> None:
    sources = {
        "rse_pf/service.py": "import rse_pf.wire.codec\nimport rse_pf.errors",
        "rse_pf/wire/codec.py": "def f():\n    from rse_pf import errors",
        "rse_pf/errors.py": "",
    }

    assert script.draw(sources).count("<path class") == 2


def test_the_order_of_the_files_does_not_change_the_picture(script: Any) -> None:
    sources: Mapping[str, str] = {
        "rse_pf/service.py": "import rse_pf.wire.codec",
        "rse_pf/wire/codec.py": "import rse_pf.errors",
        "rse_pf/errors.py": "",
    }

    assert script.draw(sources) == script.draw(dict(reversed(sources.items())))


@pytest.mark.parametrize("way", WAYS)
def test_each_way_names_existing_functions_and_passes_no_file_twice(
    page: str, repository: Path, way: str
) -> None:
    found = steps(page, way)

    assert len(found) >= 6
    assert broken_steps(found, repository) == []


def test_a_keyframe_passes_at_most_15_files(page: str) -> None:
    assert len(steps(page, "The way of a keyframe")) <= 15


def test_no_file_of_live_maps_is_passed_beside_the_way_of_a_keyframe(page: str, repository: Path) -> None:
    folder = repository / "rse_pf" / "backend" / "live_map"
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*.py")}
    rows = {file.partition("rse_pf/backend/live_map/")[2] for file, _ in steps(page, "The way of a keyframe")}

    unknown = {file for file in files - rows - LIVE_MAPS_BESIDE if not file.endswith("__init__.py")}
    assert unknown == set(), "merge what only passes a keyframe on, or name it in LIVE_MAPS_BESIDE"
    assert files >= LIVE_MAPS_BESIDE


def test_a_wrong_step_is_noticed(repository: Path) -> None:
    found = [
        ("rse_pf/service.py", ["dispatch", "Registry.get"]), ("rse_pf/geometry.py", []),
        ("rse_pf/service.py", ["Registry.vanish"]), ("rse_pf/attic.py", ["dispatch"]),
    ]  # fmt: skip

    assert broken_steps(found, repository) == [
        "rse_pf/service.py is passed twice",
        "rse_pf/geometry.py names no function",
        "rse_pf/service.py has no Registry.vanish",
        "there is no rse_pf/attic.py",
    ]
