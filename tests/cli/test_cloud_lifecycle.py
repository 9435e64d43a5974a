"""rse-pf cloud up, park, resume and down: what they show, what they ask, and their exit codes."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.clients import make_client
from rse_pf.cli.main import main
from tests.kit.account_on_moto import Formation, Killer, account_of
from tests.kit.removed_extensions import is_removed

REGION = "ap-northeast-2"


class NoQuotas:
    """Service quotas of plenty; moto lacks a call of them."""

    def __getattr__(self, method: str) -> Any:
        return lambda **asked: {"Quota": {"Value": 1000.0}}


class Person(io.StringIO):
    """Somebody at the terminal, who types these lines."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def cloud(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Formation]:
    """An empty account on moto, and tools that deploy to it."""
    moto = pytest.importorskip("moto", reason="run make setup")
    monkeypatch.chdir(tmp_path)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    tools, real = Formation(REGION, Killer()), account_of(REGION, Killer())
    account = Account(REGION, lambda name, at: NoQuotas() if name == "service-quotas" else real.client(name))
    monkeypatch.setattr("rse_pf.aws.account.open_account", lambda region: account)
    monkeypatch.setattr("rse_pf.cli.cloud.changing.make_tools", lambda *args: tools)
    monkeypatch.setattr("rse_pf.cli.cloud.up.check_tools", lambda folder: ())
    with moto.mock_aws():
        yield tools


def types(monkeypatch: pytest.MonkeyPatch, *lines: str) -> None:
    monkeypatch.setattr("sys.stdin", Person("".join(f"{line}\n" for line in lines)))


def test_nothing_is_changed_before_somebody_agrees(
    cloud: Formation, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    types(monkeypatch, "n")

    assert main(["cloud", "up"]) == 1

    page = capsys.readouterr().out
    assert "  1. prepare the account for the CDK" in page
    assert "deploy the stack Backend" in page
    assert is_removed("cloud cost") or ("USD an hour" in page and "prices.json" in page)
    assert page.endswith("go on? [y/N]\n")
    assert cloud.deployed == []


def test_where_nobody_can_be_asked_the_option_is_named(
    cloud: Formation, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())

    assert main(["cloud", "up"]) == 2

    assert capsys.readouterr().err.splitlines()[-1] == "  hint: read the plan above, then add --yes"
    assert cloud.deployed == []


@pytest.mark.parametrize("action", ["park", "resume"])
def test_what_does_not_stand_is_neither_parked_nor_resumed(
    cloud: Formation, capsys: pytest.CaptureFixture[str], action: str
) -> None:
    assert main(["cloud", action, "--yes"]) == 2
    assert "hint: " in capsys.readouterr().err


def test_what_the_account_lacks_stops_up_before_the_question(
    cloud: Formation, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "cdk.json").write_text('{"context": {"rse-pf": {"cloud": {"instance_type": "x9z.large"}}}}')

    assert main(["cloud", "up", "--yes"]) == 1

    page = capsys.readouterr().out
    assert "fail  AWS does not offer x9z.large" in page
    assert cloud.deployed == []


@pytest.mark.slow
def test_a_day_up_parked_resumed_and_down_with_proof(
    cloud: Formation, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*words: str) -> tuple[int, str]:
        return main(["cloud", *words]), capsys.readouterr().out

    assert run("status")[1].startswith("rse-pf in ap-northeast-2: absent")
    code, page = run("up", "--yes")
    assert code == 0
    assert "the platform is up: ws://robots.example.org/ws" in page
    assert "it parks itself after 24 hours" in page
    code, page = run("park", "--yes")
    assert code == 0
    assert is_removed("cloud cost") or ("up costs" in page and page.count("<- this") == 1)
    code, page = run("status")
    assert code == 0
    assert "parked, by the operator since" in page
    assert run("park", "--yes") == (0, "the platform is parked; rse-pf cloud resume ends that\n")
    assert run("resume", "--yes")[0] == 0
    code, page = run("down", "--yes")
    assert code == 0
    assert page.endswith("0 left over, 4 resources kept on purpose\n")
    assert "kept  bucket  maps-of-rse-pf  not measured yet" in page
    assert is_removed("cloud cost") or "not measured yet, 0.00 a month" in page
    types(monkeypatch, "y", "rse-pf-lab")
    assert run("down", "--delete-data")[0] == 1, "the name was wrong"
    assert len(make_client("s3", REGION).list_buckets()["Buckets"]) == 4
    code, page = run("down", "--delete-data", "--yes", "--confirm", "rse-pf")
    assert code == 0
    assert page.endswith("0 left over, 0 resources kept on purpose\n")


def test_data_is_deleted_only_under_its_name(cloud: Formation, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cloud", "down", "--delete-data", "--yes", "--confirm", "other"]) == 2
    assert "hint: it is rse-pf" in capsys.readouterr().err
