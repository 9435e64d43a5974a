"""Each example is on one page with one sentence and its command, and short enough to be read at once."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

from tests.examples.example_page import PAGE, REPOSITORY, examples, listed

MAX_LINES = 60
ROWS = listed(PAGE.read_text(encoding="utf-8"))
PROGRAMS = sorted(path for path in examples() if path.endswith(".py"))
NOTEBOOKS = sorted(path for path in examples() if path.endswith(".ipynb"))
STARTERS = {".py": ["python"], ".ipynb": ["jupyter", "lab"], "": ["rse-pf", "service", "test"]}
"""Ending of an example -> the words that its command begins with."""


def broken_rows(rows: dict[str, tuple[str, list[str]]], existing: set[str]) -> list[str]:
    """Return what the rows of the page do against the law, one line each."""
    broken = [f"{path}: is not on the page" for path in sorted(existing - set(rows))]
    broken += [f"{path}: is on the page, and not in the folder" for path in sorted(set(rows) - existing)]
    for path, (sentence, words) in rows.items():
        if not sentence.strip().endswith(".") or sentence.count(". "):
            broken.append(f"{path}: needs one sentence")
        starter = [*STARTERS[Path(path).suffix], path]
        if words[: len(starter)] != starter:
            broken.append(f"{path}: its command does not begin with {' '.join(starter)}")
    return broken


def test_the_page_lists_each_example_with_a_sentence_and_its_command() -> None:
    assert broken_rows(ROWS, examples()) == []


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        ("| [a](../examples/robots/a.py) | Runs. | `python examples/robots/a.py` |", "not on the page"),
        ("| [b](../examples/robots/b.py) | Runs | `python examples/robots/b.py` |", "one sentence"),
        ("| [b](../examples/robots/b.py) | Runs. | `python examples/robots/a.py` |", "does not begin with"),
    ],
)
def test_a_wrong_row_is_caught(row: str, complaint: str) -> None:
    assert any(complaint in line for line in broken_rows(listed(row), {"examples/robots/b.py"}))


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_is_short_and_has_help_that_fits_its_command(program: str) -> None:
    path = REPOSITORY / program
    assert path.read_text(encoding="utf-8").count("\n") <= MAX_LINES

    parser = runpy.run_path(str(path))["parser"]

    assert parser.description
    assert all(action.help for action in parser._actions)
    parser.parse_args(ROWS[program][1][2:])


@pytest.mark.parametrize("notebook", NOTEBOOKS)
def test_a_notebook_is_stored_without_outputs(notebook: str) -> None:
    book: dict[str, Any] = json.loads((REPOSITORY / notebook).read_text(encoding="utf-8"))

    assert (book["nbformat"], book["nbformat_minor"]) == (4, 5)
    code = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    assert code
    assert [(cell["outputs"], cell["execution_count"]) for cell in code] == [([], None)] * len(code)
    assert len({cell["id"] for cell in book["cells"]}) == len(book["cells"])
