"""The service verb, without a server: what new writes, and what a wrong folder or request is told."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from rse_pf.cli.main import main
from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.installed import read_service


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert main(["service", *words]) != 0
    told = capsys.readouterr()
    assert "Traceback" not in told.out + told.err
    return told.err


@pytest.mark.parametrize("language", ["python", "cpp", "lua"])
def test_new_writes_a_folder_that_is_a_service_with_a_recorded_request(language: str) -> None:
    assert main(["service", "new", "mine", "--lang", language]) == 0

    service = read_service(Path("mine"))
    recorded = json.loads(Path("mine/requests/example.json").read_text())
    assert (service.name, service.language) == ("mine", language)
    assert {"request", "reply"} <= set(recorded)
    assert "@NAME@" not in "".join(p.read_text() for p in Path("mine").rglob("*") if p.is_file())


@pytest.mark.parametrize("name", ["../up", "Mine", "", "a b", "x" * 41])
def test_a_name_that_could_be_a_path_is_refused(capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert "not a valid service name" in complaint(capsys, "new", name)


def test_an_installed_service_is_listed_and_refused_after_a_change(
    capsys: pytest.CaptureFixture[str],
) -> None:
    main(["service", "new", "mine"])
    assert main(["service", "install", "mine", "--services", "all"]) == 0
    capsys.readouterr()
    assert main(["service", "list", "--services", "all"]) == 0
    assert capsys.readouterr().out.split()[:2] == ["mine", "python"]

    with Path("all/mine/service.py").open("a") as file:
        file.write("# one byte more\n")

    assert "was changed after it was installed" in complaint(capsys, "list", "--services", "all")
    assert main(["local", "--services", "all", "--port", "0"]) != 0
    assert "was changed after it was installed" in capsys.readouterr().err


def test_a_missing_cmake_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    main(["service", "new", "mine", "--lang", "cpp"])
    monkeypatch.setattr(shutil, "which", lambda name: None)

    assert "cmake is not installed" in complaint(capsys, "install", "mine")


@pytest.mark.system
def test_a_wrong_reply_fails_the_test_and_says_where(capsys: pytest.CaptureFixture[str]) -> None:
    main(["service", "new", "mine"])
    assert main(["service", "test", "mine"]) == 0
    path = Path("mine/requests/example.json")
    recorded = json.loads(path.read_text())
    path.write_text(json.dumps({**recorded, "reply": {"no_such_field": 1}}))
    capsys.readouterr()

    assert main(["service", "test", "mine"]) == 1
    assert "WRONG" in capsys.readouterr().out


@pytest.mark.system
def test_the_crash_of_a_service_while_loading_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    main(["service", "new", "mine"])
    Path("mine/service.py").write_text("raise ValueError('no table')\n")
    capsys.readouterr()

    assert main(["service", "test", "mine"]) != 0
    told = capsys.readouterr()
    assert "no table" in told.out + told.err
    assert "Traceback" not in told.out + told.err


@pytest.mark.system
def test_run_shows_the_reason_of_a_failure_to_the_author_and_not_to_the_robot(
    capsys: pytest.CaptureFixture[str],
) -> None:
    main(["service", "new", "mine"])
    Path("mine/service.py").write_text("def serve(:\n")
    capsys.readouterr()

    assert main(["service", "run", "mine", "--once"]) == 1
    told = capsys.readouterr().out.splitlines()
    (to_robot,) = (line for line in told if line.startswith("example.json"))
    assert "SyntaxError" not in to_robot
    assert any("SyntaxError" in line and "service.py, line 1" in line for line in told)


def test_what_an_installation_compiled_among_the_templates_is_not_copied(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed = tmp_path / "installed"
    shutil.copytree(INCLUDE_FOLDER.parent / "templates", installed / "templates")
    compiled = installed / "templates" / "python" / "__pycache__"
    compiled.mkdir(exist_ok=True)
    (compiled / "service.cpython-311.pyc").write_bytes(b"\xff\x00")
    (installed / "templates" / "python" / "service.pyc").write_bytes(b"\xff\x00")
    monkeypatch.setattr("rse_pf.cli.services.service.INCLUDE_FOLDER", installed / "include")

    assert main(["service", "new", "mine"]) == 0
    assert sorted(each.name for each in Path("mine").iterdir()) == [
        "README.md", "requests", "service.json", "service.py",
    ]  # fmt: skip
