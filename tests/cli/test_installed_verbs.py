"""Verbs that other distributions add by entry points of the group ``rse_pf.verbs``."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rse_pf.cli.main import main

GREET = '''"""Greet a robot by its name.

example:
  rse-pf greet robot-1
"""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.command_line.options import Action, option
from rse_pf.terminal import show


@dataclass(frozen=True, kw_only=True)
class GreetRequest:
    robot: str = option(help="name of the robot")


def greet(request, settings):
    show(f"hello {request.robot}, answers wait {settings.session.answer_timeout_s:g} s")


ACTION = Action(request=GreetRequest, run=greet)
'''
FAILS = "\nACTION = Action(request=GreetRequest, run=lambda request, settings: [][1])\n"

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Return a function that installs a distribution with one verb, whose module has a text."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def install(verb: str, text: str | None, *, distribution: str = "my-extension") -> None:
        module = f"{distribution}_{verb}".replace("-", "_")
        information = tmp_path / f"{distribution.replace('-', '_')}-1.2.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.2\n")
        (information / "entry_points.txt").write_text(f"[rse_pf.verbs]\n{verb} = {module}\n")
        sys.modules.pop(module, None)  # that of the test before
        if text is not None:
            (tmp_path / f"{module}.py").write_text(text)

    return install


def test_a_verb_of_another_distribution_runs_with_options_and_settings(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("greet", GREET)

    assert main(["greet", "robot-1"]) == 0
    assert capsys.readouterr().out == "hello robot-1, answers wait 5 s\n"
    assert main(["greet", "--help"]) == 0
    assert capsys.readouterr().out.startswith("usage: rse-pf greet")
    assert main(["greet"]) == 2
    assert "see rse-pf greet --help" in capsys.readouterr().err


def test_the_front_page_lists_it_with_the_first_line_of_its_docstring(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("greet", GREET)

    assert main(["--help"]) == 0
    assert "\n  greet       Greet a robot by its name.\n" in capsys.readouterr().out


def test_a_misspelt_verb_of_another_distribution_is_suggested(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("greet", GREET)

    assert main(["gret"]) == 2
    assert capsys.readouterr().err.splitlines()[1] == "  hint: did you mean greet?"


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (None, "raised ModuleNotFoundError: No module named 'my_extension_greet'"),
        ("def", "raised SyntaxError: invalid syntax (my_extension_greet.py, line 1)"),
        ("x = 1\n1 / 0\n", "raised ZeroDivisionError: division by zero (my_extension_greet.py, line 2)"),
        ("", "raised AttributeError: module 'my_extension_greet' has no attribute 'ACTION'"),
        (GREET + FAILS, "raised IndexError: list index out of range (my_extension_greet.py, line"),
    ],
)
def test_a_verb_that_fails_is_one_line_that_names_its_distribution(
    install: Install, capsys: pytest.CaptureFixture[str], text: str | None, cause: str
) -> None:
    install("greet", text)

    assert main(["greet", "robot-1"]) == 1

    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith(f"RsePfError: the verb greet of my-extension 1.2 {cause}")
    assert second.startswith("  hint: update or remove it with pip")


@pytest.mark.parametrize("text", [None, "def", "1 / 0", "raise SystemExit(3)"])
def test_a_broken_verb_breaks_neither_the_front_page_nor_other_verbs(
    install: Install, capsys: pytest.CaptureFixture[str], text: str | None
) -> None:
    install("broken", text, distribution="bad-extension")
    install("greet", GREET)

    assert main(["--help"]) == 0
    page = capsys.readouterr().out
    assert "\n  broken      the verb broken of bad-extension 1.2 raised " in page
    assert "\n  greet       Greet a robot by its name.\n" in page
    assert main(["greet", "robot-1"]) == 0


def test_a_verb_of_the_platform_cannot_be_replaced(
    install: Install, capsys: pytest.CaptureFixture[str]
) -> None:
    install("errors", "1 / 0")

    assert main(["errors", "usage"]) == 0
    assert capsys.readouterr().out.startswith("usage")
    assert main(["--help"]) == 0
    assert "ZeroDivisionError" not in capsys.readouterr().out


@pytest.mark.system
def test_a_verb_of_the_platform_does_not_search_for_distributions() -> None:
    program = "import sys; from rse_pf.cli.main import main; main(['errors', 'usage']); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert "importlib.metadata" not in done.stdout.split()
