"""ORB-SLAM3 beside us: the vocabulary's recipe, the shipped figures, and that nothing of it is imported."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="pip install 'rse-pf[vision]'")

from benchmarks.peers.orbslam3 import report_page
from benchmarks.peers.vocabulary import text_of, train

ALONE = "benchmarks/peers/orbslam3_process.py"


def imported(text: str) -> set[str]:
    """Return the top packages that a module imports anywhere."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").partition(".")[0])
    return found


def test_a_vocabulary_is_a_tree_whose_words_know_the_images_that_show_them() -> None:
    rng = np.random.default_rng(3)
    centres = rng.integers(0, 256, (40, 32)).astype(np.uint8)
    descriptors = np.repeat(centres, 30, axis=0)
    descriptors[:, 0] ^= rng.integers(0, 4, len(descriptors)).astype(np.uint8)
    images = np.tile(np.arange(30), 40)

    nodes = train(descriptors, images)

    words = [node for node in nodes[1:] if not node.children]
    assert sum(len(node.rows) for node in words) == len(descriptors)
    assert all(node.parent < number for number, node in enumerate(nodes[1:], start=1))
    assert all(len(node.children) <= 10 for node in nodes)
    assert min(node.weight for node in words) >= 0.0
    shown = next(node for node in words if len(np.unique(images[node.rows])) < 30)
    assert shown.weight == pytest.approx(np.log(30 / len(np.unique(images[shown.rows]))))


def test_a_vocabulary_is_the_text_that_its_reader_takes_and_the_same_each_time() -> None:
    descriptors = np.random.default_rng(4).integers(0, 256, (300, 32)).astype(np.uint8)
    images = np.arange(300) // 30

    text = text_of(train(descriptors, images))

    head, *lines = text.split("\n")
    assert head == "10 6 0 0"
    assert all(re.fullmatch(r"\d+ [01]( \d{1,3}){32} [\d.e+-]+", line) for line in lines)
    assert not text.endswith("\n"), "an empty last line would be read as a node"
    assert text == text_of(train(descriptors, images))


def test_only_one_file_imports_the_peer_and_it_imports_nothing_of_ours(
    repository: Path, sources: Mapping[str, str]
) -> None:
    others = {
        path.relative_to(repository).as_posix(): path.read_text(encoding="utf-8")
        for folder in ("benchmarks", "scripts", "examples", "tests")
        for path in (repository / folder).rglob("*.py")
    }

    importing = {path for path, text in {**sources, **others}.items() if "pyorbslam3" in imported(text)}

    assert importing == {ALONE}
    assert imported(others[ALONE]) <= {
        "cv2",
        "json",
        "numpy",
        "pathlib",
        "pyorbslam3",
        "sys",
        "threading",
        "time",
    }
    for lock in [*(repository / "locks").iterdir(), repository / "pyproject.toml"]:
        text = lock.read_text(encoding="utf-8")
        assert not re.search(r"^\s*\"?(py)?orbslam3?|^\s*\"?evo\b", text, re.M | re.I), lock.name


def test_the_shipped_page_has_the_shipped_figures_and_names_its_commit(repository: Path) -> None:
    folder = repository / "docs" / "results" / "comparison"
    report = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))

    assert re.fullmatch("[0-9a-f]{40}", report["environment"]["commit"])
    assert (folder / "report.md").read_text(encoding="utf-8") == report_page(report)
    assert {path.suffix for path in folder.iterdir()} == {".json", ".md"}, "figures only"
