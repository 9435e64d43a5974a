"""One writer: what a command says goes through `rse_pf.terminal`, which escapes what robots wrote."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping

import pytest

WRITER = "rse_pf/terminal.py"
MAY_WRITE = {
    "rse_pf/backend/sandbox/child.py": "its output is a pipe that the worker reads and logs",
    "rse_pf/backend/supervisor/worker_handle.py": "it flushes before a fork",
    "rse_pf/cli/main.py": "it flushes at the end, and drops what a closed pipe cannot take",
}
"""File -> why it touches standard output or standard error itself; it still may not print."""
SEARCHED = ("rse_pf/", "client_sdk/")


def other_writers(tree: Mapping[str, str]) -> list[str]:
    """Return where *tree* (path to text) writes past `rse_pf.terminal`, one line each."""
    return [
        f"{path}:{line}: {what}; use rse_pf.terminal"
        for path, text in tree.items()
        if path.startswith(SEARCHED) and path != WRITER
        for line, what in _writes(ast.parse(text), may_touch=path in MAY_WRITE)
    ]


def _writes(module: ast.Module, *, may_touch: bool) -> Iterator[tuple[int, str]]:
    for node in ast.walk(module):
        if isinstance(node, ast.Name) and node.id in ("print", "pprint"):
            yield node.lineno, node.id
        if may_touch or not isinstance(node, ast.Attribute | ast.ImportFrom):
            continue
        names = {alias.name for alias in node.names} if isinstance(node, ast.ImportFrom) else {node.attr}
        of = node.module if isinstance(node, ast.ImportFrom) else ast.unparse(node.value)
        for name in names & {"stdout", "stderr", "__stdout__", "__stderr__"}:
            if of == "sys":
                yield node.lineno, f"sys.{name}"


def test_nothing_writes_past_the_one_writer(sources: Mapping[str, str]) -> None:
    assert other_writers(sources) == []


@pytest.mark.parametrize(
    "text",
    [
        "print(record.note)",
        "def f(say=print): say(1)",
        "import sys\nsys.stdout.write(record.note)",
        "import sys\nsys.stderr.writelines([note])",
        "from sys import stdout\nstdout.write(note)",
    ],
)
def test_the_law_sees_each_other_way_to_write(text: str) -> None:
    assert other_writers({"rse_pf/cli/maps/map.py": text}) != []


def test_every_exception_is_a_file_that_needs_it(sources: Mapping[str, str]) -> None:
    needed = {path for path in MAY_WRITE if list(_writes(ast.parse(sources[path]), may_touch=False))}

    assert needed == set(MAY_WRITE)
