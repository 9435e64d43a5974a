"""The table of extras fits pyproject.toml and the verbs; a missing package is named with its extra."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from rse_pf.cli.main import main
from rse_pf.command_line import extras
from rse_pf.command_line.extras import require
from rse_pf.errors import MissingExtra

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli", reason="Python 3.10 reads no TOML")


def test_a_missing_package_is_named_before_any_work(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        extras.importlib.util, "find_spec", lambda name: None if name == "rich" else found(name)
    )
    monkeypatch.chdir(tmp_path)

    with pytest.raises(MissingExtra, match="rich is not installed"):
        require("demo")
    assert main(["demo"]) == 2
    first, hint = capsys.readouterr().err.splitlines()
    assert "rich is not installed: it is in the extra 'demo'" in first
    assert hint == "  hint: pip install 'rse-pf[demo]'"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "typed", [["local"], ["local", "--lan"], ["swarm", "--robots", "2"], ["service", "run", "x"]]
)
def test_a_verb_that_starts_a_platform_names_the_extra_that_holds_all_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, typed: list[str]
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        extras.importlib.util, "find_spec", lambda name: None if name == "cryptography" else found(name)
    )
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))

    assert main(typed) == 2
    first, hint = capsys.readouterr().err.splitlines()
    assert first == "MissingExtra: cryptography is not installed: it is in the extra 'local'"
    assert hint == "  hint: pip install 'rse-pf[local]'"


@pytest.mark.parametrize(
    "typed",
    [
        ["demo", "--live"], ["map", "publish", "hall"], ["map", "live", "start", "hall"],
        ["map", "live", "stop", "hall"], ["map", "live", "forget", "hall", "robot-1"],
    ],
)  # fmt: skip
def test_a_verb_that_starts_a_live_map_names_the_extra_that_optimises_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, typed: list[str]
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        extras.importlib.util, "find_spec", lambda name: None if name == "gtsam" else found(name)
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))

    assert main(typed) == 2
    first, hint = capsys.readouterr().err.splitlines()
    assert first == "MissingExtra: gtsam is not installed: it is in the extra 'maps'"
    assert hint == "  hint: pip install 'rse-pf[maps]'"
    assert list(tmp_path.iterdir()) == []


def test_a_module_that_cannot_be_imported_is_reported_as_its_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lack(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'rich.progress'", name="rich.progress")

    monkeypatch.setattr("rse_pf.cli.settings.setting_rows", lack)

    assert main(["settings"]) == 2
    assert "pip install 'rse-pf[local]'" in capsys.readouterr().err
