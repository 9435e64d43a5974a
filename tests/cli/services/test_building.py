"""The actions lock and build, and what test and install do with packages; pip itself is run elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.cli.main import main
from rse_pf.cli.services import building
from rse_pf.services.custom.dependencies import Dependencies, tree_digest


@pytest.fixture(autouse=True)
def author(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, and a state folder of its own."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Dependencies:
    """What pip would install."""
    folder = tmp_path / "packages"
    folder.mkdir()
    (folder / "greeting.py").write_text("SAID = 'hello'\n")
    made = Dependencies(
        folder=folder,
        digest=tree_digest(folder),
        packages={"greeting": "1.2"},
        platform=building.platform_tag(),
    )
    monkeypatch.setattr(building, "build_dependencies", lambda *_: made)
    return made


def complaint(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    capsys.readouterr()
    assert main(["service", *words]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert len(told.err.splitlines()) == 2, told.err
    return told.err


HASH = "--hash=sha256:" + "a" * 64


def test_an_unlocked_requirement_is_refused_by_every_action_that_builds(
    capsys: pytest.CaptureFixture[str],
) -> None:
    main(["service", "new", "mine"])
    Path("mine/requirements.txt").write_text("tabulate>=0.9\n")

    for action in ("test", "run", "install", "build"):
        told = complaint(capsys, action, "mine")
        assert "requirements.txt, line 1: 'tabulate>=0.9' is not locked" in told
        assert "rse-pf service lock" in told


def test_packages_are_for_services_in_python(capsys: pytest.CaptureFixture[str]) -> None:
    main(["service", "new", "mine", "--lang", "lua"])
    Path("mine/requirements.txt").write_text(f"greeting==1.2 {HASH}\n")

    assert "is for services in Python, mine is in lua" in complaint(capsys, "build", "mine")
    assert "is for services in Python" in complaint(capsys, "lock", "mine")


def test_build_says_what_a_service_runs_with(
    capsys: pytest.CaptureFixture[str], packages: Dependencies
) -> None:
    main(["service", "new", "mine"])
    capsys.readouterr()

    assert main(["service", "build", "mine"]) == 0
    told = capsys.readouterr().out
    assert "mine has greeting 1.2" in told
    assert packages.digest[:16] in told


def test_install_copies_the_packages_and_list_shows_the_identity(
    capsys: pytest.CaptureFixture[str], packages: Dependencies
) -> None:
    main(["service", "new", "mine"])
    assert main(["service", "install", "mine", "--services", "all"]) == 0
    document = json.loads(Path("all/mine/dependencies.json").read_text())
    capsys.readouterr()

    assert main(["service", "list", "--services", "all"]) == 0

    assert document["digest"] == packages.digest
    assert Path("all/.dependencies", packages.digest, "greeting.py").read_text() == "SAID = 'hello'\n"
    name, _, _, identity, _ = capsys.readouterr().out.split()
    assert name == "mine"
    assert len(identity) == 12
