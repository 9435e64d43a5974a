"""Wrong inputs: one line and a hint that fits, the right exit code, and never a traceback."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from rse_pf.cli.main import main
from tests.kit.removed_extensions import skip_if_removed
from tests.kit.wrong_inputs import WRONG_INPUTS, WrongInput, make_files

TYPED_IN_A_SHELL = ("maps", "settings --settings misspelt.json", "map list --store dir:/typo")
AS_PROCESSES = [each for each in WRONG_INPUTS if each.typed in TYPED_IN_A_SHELL]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("wrong")
    make_files(made)
    return made


@pytest.fixture
def typed_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder, in which the commands are typed; they leave nothing there."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(folder / "state"))
    for name in [name for name in os.environ if name.startswith("AWS_")]:
        monkeypatch.delenv(name)
    before = sorted(each for each in folder.rglob("*") if "state" not in each.parts)
    yield folder
    assert sorted(each for each in folder.rglob("*") if "state" not in each.parts) == before


def judge(wrong: WrongInput, code: int, out: str, err: str) -> None:
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == 2, err
    first, hint = lines
    assert wrong.says in first
    assert first.split(":")[0].isidentifier(), "begins with the name of the error"
    assert hint.startswith("  hint: ")
    assert wrong.hint in hint
    assert code == wrong.code


@pytest.mark.parametrize("wrong", WRONG_INPUTS, ids=lambda wrong: wrong.typed)
def test_a_wrong_input_is_one_line_with_a_hint_that_fits(
    wrong: WrongInput, typed_there: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    skip_if_removed(wrong.typed)
    code = main(shlex.split(wrong.typed))

    told = capsys.readouterr()
    judge(wrong, code, told.out, told.err)


@pytest.mark.system
@pytest.mark.parametrize("wrong", AS_PROCESSES, ids=lambda wrong: wrong.typed)
def test_a_process_says_the_same(wrong: WrongInput, typed_there: Path) -> None:
    command = [sys.executable, "-m", "rse_pf.cli.main", *shlex.split(wrong.typed)]
    told = subprocess.run(command, capture_output=True, text=True, check=False)

    judge(wrong, told.returncode, told.stdout, told.stderr)
