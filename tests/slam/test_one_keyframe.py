"""A keyframe has one form as bytes: nothing else in the product holds its parts, or makes these bytes."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

MAKERS = {"client_sdk/live/mapper.py", "rse_pf/live_map/versions.py", "rse_pf/slam/keyframe_v1.py"}
"""The robot, the start of a live map from a version, and the reader of version 1."""


def sources(repository: Path) -> Iterator[tuple[str, ast.Module]]:
    for folder in ("rse_pf", "client_sdk"):
        for path in sorted((repository / folder).rglob("*.py")):
            yield path.relative_to(repository).as_posix(), ast.parse(path.read_text(encoding="utf-8"))


def makers_of_bytes(file: str, tree: ast.Module) -> set[str]:
    """Return *file* if it calls `encode_keyframe`."""
    calls = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call))
    return {file for called in calls if isinstance(called, ast.Name) and called.id == "encode_keyframe"}


def other_forms(file: str, tree: ast.Module) -> list[str]:
    """Return the classes that hold encoded features, those that read version 1 left out."""
    return [
        f"{file}: {node.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef) and not node.name.endswith("V1")
        for field in node.body
        if isinstance(field, ast.AnnAssign) and ast.unparse(field.target) == "features"
        if "bytes" in ast.unparse(field.annotation)
    ]


def test_only_the_readers_of_version_1_hold_encoded_features(repository: Path) -> None:
    assert [form for file, tree in sources(repository) for form in other_forms(file, tree)] == []


def test_the_bytes_of_a_keyframe_are_made_in_three_places(repository: Path) -> None:
    assert set().union(*(makers_of_bytes(file, tree) for file, tree in sources(repository))) == MAKERS


def test_a_second_form_is_noticed() -> None:
    tree = ast.parse("class Sent:\n    features: bytes | None\n\n\ndata = encode_keyframe(made)\n")

    assert other_forms("a.py", tree) == ["a.py: Sent"]
    assert makers_of_bytes("a.py", tree) == {"a.py"}
