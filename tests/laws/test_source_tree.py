"""docs/explanation/source_tree.md is current, and has every module with the beginning of its docstring."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.source_tree import TARGET, first_sentence, page, read_sources


def test_the_page_is_written_from_todays_docstrings(repository: Path) -> None:
    committed = (repository / TARGET).read_text(encoding="utf-8")

    assert committed == page(read_sources(repository)), "run make docs"


def test_every_module_and_package_has_a_sentence(repository: Path) -> None:
    sources = read_sources(repository)

    assert [path for path, text in sources.items() if text.strip() and not first_sentence(text)] == []


def test_a_package_has_its_modules_below_its_own_sentence() -> None:
    sources = {
        "rse_pf/wire/__init__.py": '"""The protocol.\n\nSockets do not belong here."""',
        "rse_pf/wire/codec.py": '"""Turn messages into bytes. Nothing else."""',
        "client_sdk/robot.py": '"""A robot."""',
    }

    text = page(dict(reversed(sources.items())))

    assert text == page(sources)
    assert text.endswith(
        "\n## rse_pf/wire\n\nThe protocol.\n\n- `codec.py`: Turn messages into bytes.\n"
        "\n## client_sdk\n\n- `robot.py`: A robot.\n"
    )


@pytest.mark.parametrize(
    ("docstring", "sentence"),
    [
        ("Solve it.  Then stop.", "Solve it."),
        ("The boxes of Fig. 2 (Sect. 5.2) on AWS.\n\nMore.", "The boxes of Fig. 2 (Sect. 5.2) on AWS."),
        ("A sentence over\ntwo lines, of ``rse_pf.wire``.", "A sentence over two lines, of `rse_pf.wire`."),
        ("Write NAME.json", "Write NAME.json"),
        ("Map a <name> to a * b.", "Map a &lt;name> to a \\* b."),
    ],
)
def test_the_first_sentence_is_one_line_of_markdown(docstring: str, sentence: str) -> None:
    assert first_sentence(f'"""{docstring}"""') == sentence
