"""Every error says its cause, what to check and how to fix it, and the page of errors says the same."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rse_pf import errors
from rse_pf.cli.errors import errors_page, explanations
from rse_pf.cli.main import VERBS, main
from rse_pf.errors import ERRORS_PAGE, RsePfError
from tests.kit.removed_extensions import is_removed

VERB = re.compile(r"rse-pf ([a-z]+)")


def test_every_code_is_explained() -> None:
    codes = {
        kind.code for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, RsePfError)
    }

    assert {each.code for each in explanations()} == codes
    for each in explanations():
        for text in (each.cause, each.check, each.fix):
            assert text.endswith("."), (each.code, text)
            assert len(text.split()) >= 5, (each.code, text)


def test_the_page_is_generated_from_the_docstrings_and_has_every_address(repository: Path) -> None:
    page = (repository / ERRORS_PAGE).read_text(encoding="utf-8")

    assert page == errors_page(explanations()), "run make docs"
    for each in explanations():
        kind = getattr(errors, each.name)
        assert kind.address().startswith(f"{ERRORS_PAGE}#{each.code},")
        assert f"\n## {each.code}\n" in page


def test_the_explanations_name_verbs_that_exist() -> None:
    named = set(VERB.findall(errors_page(explanations())))

    assert "token" in named
    assert {verb for verb in named - VERBS.keys() if not is_removed(verb)} <= {"errors"}


@pytest.mark.parametrize("word", ["no-consensus", "NoConsensus"])
def test_the_command_line_explains_a_code_or_a_class(capsys: pytest.CaptureFixture[str], word: str) -> None:
    assert main(["errors", word]) == 0

    first, cause, check, fix = capsys.readouterr().out.splitlines()
    assert first.startswith("no-consensus (NoConsensus): ")
    assert [line.split()[0] for line in (cause, check, fix)] == ["cause", "check", "fix"]


@pytest.mark.parametrize("words", [["errors"], ["errors", "busy"]])
def test_the_command_line_shows_no_marks_of_a_page(
    capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    assert any("``" in each.meaning for each in explanations())

    assert main(words) == 0

    assert "``" not in capsys.readouterr().out
