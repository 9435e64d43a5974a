"""The page's files: what others wrote is listed with digests; ours asks nobody outside and runs no text."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest

from rse_pf.fleet_page.static_files import STATIC, page_files, vendored

VENDOR = STATIC / "vendor"
OURS = sorted(file for file in STATIC.iterdir() if file.suffix in (".js", ".html", ".css"))
_RUNS_TEXT = re.compile(
    r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function|srcdoc|javascript:"
)
_OUTSIDE = re.compile(r"https?://|//[a-z0-9-]+\.[a-z]{2,}/|@import|import\(\s*[^\"]")


def test_every_vendored_file_is_listed_with_its_digest_version_and_licence() -> None:
    listed = {name: digest for each in vendored() for name, digest in each["files"].items()}
    present = {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in VENDOR.iterdir()}
    del present["vendored.json"]

    assert listed == present
    assert {(each["name"], each["version"], each["licence"]) for each in vendored()} == {
        ("three", "0.187.0", "MIT"),
        ("uplot", "1.6.32", "MIT"),
    }
    for each in vendored():
        (licence,) = [name for name in each["files"] if name.endswith(".LICENSE")]
        assert "Permission is hereby granted, free of charge" in (VENDOR / licence).read_text("utf-8")


@pytest.mark.parametrize("file", OURS, ids=lambda file: str(file.name))
def test_no_file_of_ours_makes_markup_of_text_or_asks_outside(file: Path) -> None:
    text = file.read_text("utf-8")

    assert not _RUNS_TEXT.search(text)
    assert not _OUTSIDE.search(text)
    if file.suffix == ".html":
        assert not re.search(r"<script(?![^>]*src=)|\son[a-z]+=|style=", text)


@pytest.mark.parametrize("text", ["a.innerHTML = b", 'fetch("https://x.example/a")', "eval(x)"])
def test_the_law_of_the_files_catches(text: str) -> None:
    assert _RUNS_TEXT.search(text) or _OUTSIDE.search(text)


def test_every_module_that_is_imported_is_there() -> None:
    files = page_files()
    for file in OURS:
        for name in re.findall(r"(?:from|import\()\s*\"\./([^\"]+)\"", file.read_text("utf-8")):
            assert f"/{name}" in files, (file.name, name)
    assert files["/"] is not None


def test_the_files_are_in_the_package(repository: Path) -> None:
    text = (repository / "pyproject.toml").read_text("utf-8")

    assert '"fleet_page/static/*", "fleet_page/static/vendor/*"' in text
