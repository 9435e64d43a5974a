"""One name means one thing: no public class name twice, and no name of 0.1.0 that was replaced."""

from __future__ import annotations

import ast
import json
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config.renames import RENAMED_FILE

TABLE: dict[str, dict[str, Any]] = json.loads(RENAMED_FILE.read_text(encoding="utf-8"))
SEARCHED = (
    "rse_pf", "client_sdk", "stacks", "lambda_pnp", "docs", "benchmarks", "examples", "tests", "fuzz",
    "scripts", "README.md", "CONTRIBUTING.md", "Makefile", "app.py", "cdk.json",
)  # fmt: skip
LEFT_OUT = (
    "rse_pf/config/renamed.json", "docs/results/", "tests/laws/test_names.py", "tests/config/test_renames.py",
    "tests/renamed.json",
)  # fmt: skip
ENDINGS = {".py", ".md", ".json", ".toml", ".sh", ".c", ".h", ".hpp", ".cpp", ".lua", ".service", ""}
MEANT: dict[str, dict[str, str]] = {
    "benchmarks/maps/services.py": {"walls": "of a synthetic room"},
    "client_sdk/simulator/": {"door": "of the rendered world", "doors": "the same", "seams": "between tiles"},
    "tests/client_sdk/simulator/": {"doors": "of the rendered world"},
    "rse_pf/services/mapping/wifi.py": {"walls": "they damp the signal"},
    "rse_pf/services/synthetic_maps.py": {"walls": "of a synthetic room"},
    "tests/services/mapping/test_icp.py": {"walls": "of a synthetic room"},
    "rse_pf/backend/gateway/": {"unread_bytes": "bytes that wait in the decoder thread"},
    "tests/backend/gateway/": {"unread_bytes": "the same"},
    "tests/cli/test_main.py": {"--size": "is refused with the new name"},
}
"""Path or folder -> word -> why that word is right there."""
TEMPLATES = "/templates/"
UNREAD = {"__pycache__", "node_modules"}


def double_class_names(tree: Mapping[str, str]) -> list[str]:
    """Return the public class names that more than one module of *tree* defines, one line each."""
    places: defaultdict[str, list[str]] = defaultdict(list)
    for path, text in tree.items():
        if TEMPLATES not in path:
            for node in ast.parse(text).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places[node.name].append(path)
    return [f"{name}: {', '.join(paths)}" for name, paths in places.items() if len(paths) > 1]


def old_names(tree: Mapping[str, str]) -> list[str]:
    """Return where *tree* (path to text) uses a name or word of the table of renames, one line each."""
    lowered = {path: text.lower() for path, text in tree.items()}
    return [
        f"{path}:{text.count(chr(10), 0, found.start()) + 1}: {found.group()!r}: {_advice(found.group())}"
        for path, text in tree.items()
        for needle, pattern in PATTERNS
        if needle in lowered[path]
        for found in pattern.finditer(text)
        if not _is_meant(path, found.group().lower())
    ]


def _advice(name: str) -> str:
    for kind in reversed(TABLE.values()):
        for old, new in kind.items():
            if name.lower() in (old.lower(), old.rpartition(".")[2].lower()):
                return f"write {new}" if new else "it is a constant now"
    return "write the new name"


def _is_meant(path: str, word: str) -> bool:
    return any(path.startswith(place) and word in words for place, words in MEANT.items())


def _patterns() -> Iterator[tuple[str, re.Pattern[str]]]:
    """Yield a text that is quickly looked for, in small letters, and the pattern that decides."""
    known = {each.partition(".")[2] for each in TABLE["settings"].values() if each}
    for old, new in TABLE["settings"].items():
        name = old.partition(".")[2]
        yield old, re.compile(rf"(?<![\w.]){re.escape(old)}(?!\w)")
        if new and "_" in name and name not in known:
            yield name, re.compile(rf"(?<!\w){name}(?!\w)")
    for old in TABLE["options"]:
        yield old, re.compile(rf"(?<![\w-]){old}(?![\w-])")
    for old in (*TABLE["metrics"], *TABLE["classes"]):
        yield old.lower(), re.compile(rf"(?<!\w){old}(?!\w)")
    for old in TABLE["imports"]:
        path = Path(RENAMED_FILE.parents[2], *old.split("."))
        if not path.is_dir() and not path.with_suffix(".py").exists():
            yield old, re.compile(rf"(?<![\w./]){re.escape(old)}(?!\w)")
            file = f"{old.replace('.', '/')}.py"
            yield file, re.compile(rf"(?<![\w./]){re.escape(file)}")
    for word in TABLE["words"]:
        yield word, re.compile(rf"(?<![\w-]){word}(?![\w-])", re.IGNORECASE)


PATTERNS = tuple(_patterns())


@pytest.fixture(scope="module")
def searched(repository: Path) -> Mapping[str, str]:
    """Every text file in which the old names are searched, by path from the checkout."""
    files = (
        file
        for each in SEARCHED
        for file in ([repository / each] if (repository / each).is_file() else (repository / each).rglob("*"))
    )
    named = {file.relative_to(repository).as_posix(): file for file in files if file.suffix in ENDINGS}
    return {
        name: file.read_text(encoding="utf-8", errors="replace")
        for name, file in named.items()
        if file.is_file()
        and not name.startswith(LEFT_OUT)
        and not {"__pycache__", "node_modules"} & {*file.parts}
    }


def test_no_public_class_name_is_used_twice(sources: Mapping[str, str]) -> None:
    assert double_class_names(sources) == []


def test_a_double_class_name_is_caught() -> None:
    tree = {
        "rse_pf/a.py": "class Link: ...\nclass _Own: ...",
        "client_sdk/b.py": "class Link: ...\nclass _Own: ...",
    }

    assert double_class_names(tree) == ["Link: rse_pf/a.py, client_sdk/b.py"]


def test_no_old_name_is_left(searched: Mapping[str, str]) -> None:
    assert old_names(searched) == []


def test_every_exception_is_needed(searched: Mapping[str, str]) -> None:
    used = {
        (place, word)
        for place, words in MEANT.items()
        for word in words
        for path, text in searched.items()
        if path.startswith(place) and re.search(rf"(?i:(?<!\w){word}(?!\w))", text)
    }

    assert {(place, word) for place, words in MEANT.items() for word in words} == used


@pytest.mark.parametrize(
    ("text", "advice"),
    [
        ("settings.session.silence_s", "write session.stall_timeout_s"),
        ("SessionSettings(silence_s=1.0)", "write session.stall_timeout_s"),
        ("set `cloud.lab` to false", "write cloud.allow_insecure"),
        ("raise serving.read_buffer_bytes", "it is a constant now"),
        ("rse-pf serve --size 0.25", "write --emulated-cores"),
        ("rate(rse_pf_environments[1m])", "write rse_pf_sandboxes"),
        ("from rse_pf.backend.seams import Clock", "write rse_pf.backend.ports"),
        ("see rse_pf/backend/seams.py", "write"),
        ("except TurnedAway as refusal:", "write Rejected"),
        ("The walls of an isolated process.", "write isolation"),
        ('hint="mend the file"', "write fix"),
    ],
)
def test_an_old_name_is_caught(text: str, advice: str) -> None:
    lines = old_names({"docs/page.md": f"First line.\n{text}\n"})

    assert all(line.startswith("docs/page.md:2: ") for line in lines)
    assert any(advice in line for line in lines)
