"""No file names a machine, a registry or an unfinished task."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest

WRITTEN_BY_MACHINES = (
    "locks/",
    "tests/wire/golden/",
    "docs/asyncapi.json",
    "LICENSE",
    "rse_pf/extensions/fleet_page/static/vendor/",
)
"""Or by others: their packages stay as they were published."""

_PLACES = re.compile(r"/(?:home|Users|root)/\w|file:///|[a-z0-9-]+\.internal\b")
_REGISTRY = re.compile(r"https?://[^\s\"')>]*(?:artifactory|nexus|:8080|:3128|/simple\b)")
_LATER = re.compile(r"\b(?:TODO|FIXME|XXX|HACK)\b")
_ADDRESS = re.compile(r"(?<![\d.])(\d{1,3})\.(\d{1,3})\.(\d{1,3})\.(\d{1,3})(?![\d.])")
_FREE = (
    "0.", "10.", "127.", "169.254.", "172.", "192.168.", "192.0.2.", "198.51.100.", "203.0.113.", "255.",
)  # fmt: skip
_LAW = "tests/laws/test_files.py"


def broken_file_laws(tree: Mapping[str, str]) -> list[str]:
    """Return what the files of *tree* (path to text) do against the laws, one line each."""
    broken = []
    for path, text in tree.items():
        if path == _LAW or path.startswith(WRITTEN_BY_MACHINES):
            continue
        for what, pattern in (
            ("a place on a machine", _PLACES),
            ("a registry", _REGISTRY),
            ("later", _LATER),
        ):
            found = pattern.search(text)
            if found:
                broken.append(f"{path}: names {what}: {found.group()!r}")
        if path.startswith(("rse_pf/", "client_sdk/", "lambda_pnp/")):
            broken += [
                f"{path}: names the address {found.group()}"
                for found in _ADDRESS.finditer(text)
                if not found.group().startswith(_FREE)
            ]
    return broken


@pytest.fixture(scope="module")
def tracked(repository: Path) -> Mapping[str, str]:
    """Every text file that git tracks."""
    names = subprocess.run(
        ["git", "-C", str(repository), "ls-files", "-z"], capture_output=True, check=False
    ).stdout.decode()
    tree = {}
    for name in names.split("\0"):
        file = repository / name
        if name and file.is_file():
            data = file.read_bytes()
            if b"\0" not in data[:4096]:
                tree[name] = data.decode("utf-8", "replace")
    if not tree:
        pytest.skip("not a git checkout: the files that belong to it are unknown")
    return tree


def test_the_tracked_files_keep_the_laws(tracked: Mapping[str, str]) -> None:
    assert broken_file_laws(tracked) == []


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("see /home/someone/notes", "place on a machine"),
        ('"""D."""\n# TODO later', "later"),
        ("pip install -i http://mirror:8080/simple x", "registry"),
        ("host = '52.95.110.1'", "address"),
    ],
)
def test_the_law_of_files_catches(text: str, complaint: str) -> None:
    assert any(complaint in line for line in broken_file_laws({"rse_pf/local/box.py": text}))
