"""The table of extras fits pyproject.toml and the verbs; a missing package is named with its extra."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from rse_pf.cli.main import VERBS, main
from rse_pf.command_line import extras
from rse_pf.command_line.extras import EXTRAS, VERBS_NEED, extra_of_module, modules_of, require
from rse_pf.errors import MissingExtra

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli", reason="Python 3.10 reads no TOML")


@pytest.fixture
def declared(repository: Path) -> dict[str, Any]:
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {**project["optional-dependencies"], "base": project["dependencies"]}


def package_of(requirement: str) -> str:
    return re.split(r"[\[<>=; ]", requirement)[0]


def test_every_extra_is_known_with_packages_that_it_installs(declared: dict[str, Any]) -> None:
    assert set(EXTRAS) == set(declared)
    for name, extra in EXTRAS.items():
        packages = {package_of(each) for each in declared[name]}
        assert packages - {"rse-pf"} == set(extra.modules.values()), name


def test_every_verb_says_what_it_needs() -> None:
    assert {verb.split()[0] for verb in VERBS_NEED} == set(VERBS)
    assert {extra for needed in VERBS_NEED.values() for extra in needed} <= set(EXTRAS)


def test_an_extra_has_the_modules_of_those_that_it_includes() -> None:
    assert {"rich", "uvicorn", "picows", "jwt"} <= modules_of("local").keys()


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


def test_a_module_that_cannot_be_imported_is_reported_as_its_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lack(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'rich.progress'", name="rich.progress")

    monkeypatch.setattr("rse_pf.cli.settings.setting_rows", lack)

    assert main(["settings"]) == 2
    assert "pip install 'rse-pf[local]'" in capsys.readouterr().err


def test_a_module_of_no_extra_is_a_defect_and_stays_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def lack(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'rse_pf.nothing'", name="rse_pf.nothing")

    monkeypatch.setattr("rse_pf.cli.settings.setting_rows", lack)

    assert extra_of_module("rse_pf.nothing") is None
    with pytest.raises(ModuleNotFoundError):
        main(["settings"])
