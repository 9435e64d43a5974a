"""Benchmarks are functions of one frame: one command line, one percentile, one report, one table of bars."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from benchmarks.frame.registry import names
from scripts.site.blocks import pages

FRAME = "benchmarks/frame/"
FORBIDDEN = {
    "a command line of its own": re.compile(r"\bargparse\b|\bdef main\b"),
    "a second percentile": re.compile(
        r"\bdef _?(?:percentiles?|quantiles?|_p\d\d)\b|\bnp\.(?:nan)?(?:percentile|quantile)\b"
        r"|statistics\.quantiles|\[(?:min\()?(?:int\()?(?:0\.9|len\(\w+\) \* p)"
    ),
    "a second look at the load": re.compile(r"\bgetloadavg\b"),
}
APART = ("benchmarks/maps/g2o_reference.py", "benchmarks/peers/orbslam3_process.py")
"""Programs of other interpreters, which have nothing of this project; they read their orders themselves."""
COMMAND = re.compile(r"python -m benchmarks ([a-z]\w*\.\w+)")
OLD_COMMAND = re.compile(r"python -m benchmarks\.(\w+\.\w+)")


def broken_frame_laws(tree: Mapping[str, str]) -> list[str]:
    """Return what the benchmarks of *tree* (path to text) do outside of the frame, one line each."""
    return [
        f"{path}: {what}: {found.group()!r}"
        for path, text in tree.items()
        if not path.startswith((FRAME, "benchmarks/__main__.py"))
        for what, pattern in FORBIDDEN.items()
        if not (path in APART and what == "a command line of its own")
        for found in pattern.finditer(text)
    ]


def unknown_commands(text: str, known: Mapping[str, str]) -> list[str]:
    """Return the benchmarks that *text* names in a command and that do not exist, or in the old form."""
    return [*(name for name in COMMAND.findall(text) if name not in known), *OLD_COMMAND.findall(text)]


def test_every_benchmark_uses_the_frame(repository: Path) -> None:
    tree = {
        path.relative_to(repository).as_posix(): path.read_text(encoding="utf-8")
        for path in (repository / "benchmarks").rglob("*.py")
    }

    assert broken_frame_laws(tree) == []


@pytest.mark.parametrize(
    "text",
    [
        "import argparse",
        "def main() -> None: ...",
        "def percentile(values): ...",
        "p99 = np.percentile(times, 99)",
        "cuts = statistics.quantiles(taken, n=100)",
        "p99 = ordered[int(0.99 * (len(ordered) - 1))]",
        "load = os.getloadavg()",
    ],
)
def test_a_second_one_is_caught(text: str) -> None:
    assert len(broken_frame_laws({"benchmarks/server/another.py": text})) == 1


def test_pages_and_modules_name_benchmarks_that_exist(repository: Path) -> None:
    known = dict(names())
    files = [
        *(repository / page for page in pages(repository)), *(repository / "benchmarks").rglob("*.py"),
        *(repository / "rse_pf").rglob("*.py"), *(repository / "benchmarks").rglob("*.md"),
    ]  # fmt: skip
    wrong = {
        file.relative_to(repository).as_posix(): unknown
        for file in files
        if file.relative_to(repository).as_posix() not in APART
        if (unknown := unknown_commands(file.read_text(encoding="utf-8"), known))
    }

    assert wrong == {}


def test_a_command_of_no_benchmark_is_caught() -> None:
    text = "python -m benchmarks server.nothing, python -m benchmarks.server.tails"

    assert unknown_commands(text, {"server.tails": ""}) == ["server.nothing", "server.tails"]
