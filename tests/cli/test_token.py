"""Tokens on the command line: issued with a file that only its owner reads, inspected without secrets."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import pytest

from rse_pf.cli.main import main
from rse_pf.local.firewall import ensure_key, key_file, key_set_file
from rse_pf.local.state import settings_file


@pytest.fixture
def platform(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a platform that has run once."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    folder = tmp_path / "rse-pf" / "default"
    folder.mkdir(parents=True)
    ensure_key(folder, seed=b"s" * 32, key_id="k")
    return folder


def issued(capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main(["token", "issue", "robot-1", *options]) == 0
    (token,) = capsys.readouterr().out.splitlines()
    return token


def inspected(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, Any]]:
    code = main(["token", "inspect", *words])
    return code, json.loads(capsys.readouterr().out)


def test_an_issued_token_is_verified_by_the_platforms_public_keys(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    code, told = inspected(capsys, issued(capsys, "--life", "60"))

    assert code == 0
    assert told["verified"] == "yes"
    assert told["claims"]["sub"] == "robot-1"
    assert told["claims"]["exp"] - told["claims"]["iat"] == 60
    assert 50 <= told["seconds_left"] <= 60


def test_no_two_tokens_are_the_same(capsys: pytest.CaptureFixture[str], platform: Path) -> None:
    assert issued(capsys) != issued(capsys)


def test_a_token_can_be_signed_and_checked_with_named_files(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    token = issued(capsys, "--name", "other", "--key", str(key_file(platform)))

    code, told = inspected(capsys, token, "--name", "other", "--keys", str(key_set_file(platform)))
    assert (code, told["verified"]) == (0, "yes")


def test_a_token_is_shown_even_when_nobody_knows_its_key(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    code, told = inspected(capsys, issued(capsys), "--name", "other")

    assert code == 0
    assert told["verified"].startswith("unknown")
    assert told["header"]["kid"] == "k"


def test_a_token_of_a_stranger_fails_the_check(
    capsys: pytest.CaptureFixture[str], platform: Path, tmp_path: Path
) -> None:
    token = issued(capsys)
    (tmp_path / "stranger").mkdir()
    ensure_key(tmp_path / "stranger", seed=b"t" * 32, key_id="k")

    code, told = inspected(capsys, token, "--keys", str(key_set_file(tmp_path / "stranger")))
    assert (code, told["verified"]) == (1, "no: bad-signature-or-claims")


def test_a_token_is_read_from_the_standard_input(
    capsys: pytest.CaptureFixture[str], platform: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(issued(capsys) + "\n"))

    code, told = inspected(capsys, "-")
    assert (code, told["verified"]) == (0, "yes")


def test_a_token_follows_the_settings_that_its_platform_was_started_with(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    chosen = {"context": {"rse-pf": {"auth": {"issuer": "my-lab", "token_life_s": 30}}}}
    settings_file(platform).write_text(json.dumps(chosen))

    _, told = inspected(capsys, issued(capsys))

    assert told["claims"]["iss"] == "my-lab"
    assert told["verified"] == "yes"
    assert told["claims"]["exp"] - told["claims"]["iat"] == 30


def test_a_longer_life_than_the_settings_allow_is_refused(
    capsys: pytest.CaptureFixture[str], platform: Path
) -> None:
    assert main(["token", "issue", "robot-1", "--life", "901"]) == 2
    assert "901 s is not within 900 s" in capsys.readouterr().err
