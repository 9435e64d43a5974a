"""rse-pf cloud: what it prints, its exit codes, and one line with a hint where there is no account."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.group import AutoScalingGroup, Server
from rse_pf.aws.lifecycle.deployment import Deployment
from rse_pf.cli.cloud import doctor
from rse_pf.cli.cloud.doctor import check_tools
from rse_pf.cli.main import main
from rse_pf.config.resource_names import STACKS
from tests.kit.emulated_aws import NoRoom, emulated_aws
from tests.kit.removed_extensions import is_removed

REGION = "ap-northeast-2"


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No settings file of the checkout plays a part."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A person who never signed in."""
    pytest.importorskip("boto3", reason="run make setup")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))


@pytest.fixture
def emulator(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An account in this process, or on LocalStack."""
    with emulated_aws(monkeypatch, request.node.nodeid):
        yield


@pytest.mark.parametrize("action", ["status", "leftovers"])
def test_without_credentials_there_is_one_line_and_a_hint(
    capsys: pytest.CaptureFixture[str], nobody: None, action: str
) -> None:
    assert main(["cloud", action]) == 2

    assert capsys.readouterr().err.splitlines() == [
        "ConfigurationError: no AWS credentials",
        "  hint: set AWS_PROFILE, or sign in with aws sso login or aws configure",
    ]


def test_the_doctor_says_all_it_can_without_an_account(
    capsys: pytest.CaptureFixture[str], nobody: None
) -> None:
    assert main(["cloud", "doctor"]) == 1

    lines = capsys.readouterr().out.splitlines()
    assert "fail  no packages in build" in lines
    assert "      fix: make assets" in lines
    assert "fail  no AWS credentials" in lines
    assert lines[-1].endswith("to fix first")


def test_the_doctor_asks_the_account(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, emulator: None
) -> None:
    account = Account(
        REGION, lambda name, at: NoRoom() if name == "service-quotas" else make_client(name, at)
    )
    monkeypatch.setattr("rse_pf.aws.account.open_account", lambda region: account)

    assert main(["cloud", "doctor"]) == 1

    page = capsys.readouterr().out
    assert "ok    signed in as arn:aws:" in page
    assert "      fix: rse-pf cloud up does it" in page
    assert "fail  quota 0, needed 22" in page


def checkout(folder: Path, *, version: str = "2.1148.1", reads: str = ">=55.5.0") -> Path:
    """A checkout with packages and a command line of the CDK."""
    for name in ("servers", "lambda"):
        (folder / "build" / name).mkdir(parents=True)
        (folder / "build" / name / "file").touch()
    cli = folder / "node_modules" / "aws-cdk"
    cli.mkdir(parents=True)
    document = {"version": version, "devDependencies": {"@aws-cdk/cloud-assembly-schema": reads}}
    (cli / "package.json").write_text(json.dumps(document), encoding="utf-8")
    pinned = {"devDependencies": {"aws-cdk": "2.1148.1"}}
    (folder / "package.json").write_text(json.dumps(pinned), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("changes", "grade"),
    [
        ({}, "ok"),
        ({"version": "2.1150.0"}, "warn"),
        ({"version": "3.0.0", "reads": ">=43.0.0"}, "fail"),
        ({"reads": "newest"}, "fail"),
    ],
)
def test_a_command_line_that_cannot_read_the_librarys_assembly_is_caught(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, str], grade: str
) -> None:
    monkeypatch.setattr(doctor.metadata, "version", lambda name: "55.3.0")

    _, cli, packages = check_tools(checkout(tmp_path, **changes))

    assert (cli.grade, packages.grade) == (grade, "ok")
    assert bool(cli.fix) == (grade != "ok")


def test_the_command_line_of_the_lock_reads_what_the_library_writes(repository: Path) -> None:
    if not (repository / "node_modules" / "aws-cdk").is_dir():
        pytest.skip("the CDK's command line is not installed: make setup")

    _, cli, _ = check_tools(repository)

    assert cli.grade == "ok", cli


@pytest.mark.system
@pytest.mark.parametrize(("told", "grade"), [("v24.1.0", "ok"), ("v20.9.9", "fail"), ("nonsense", "fail")])
def test_a_node_that_the_cdk_no_longer_supports_is_caught(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, told: str, grade: str
) -> None:
    node = tmp_path / "node"
    node.write_text(f"#!/bin/sh\necho {told}\n", encoding="utf-8")
    node.chmod(0o755)
    monkeypatch.setattr(doctor.sysconfig, "get_path", lambda name: str(tmp_path))

    assert next(check_tools(tmp_path)).grade == grade


def show(monkeypatch: pytest.MonkeyPatch, fleet: AutoScalingGroup) -> None:
    monkeypatch.setattr("rse_pf.aws.account.open_account", lambda region: Account(region))
    monkeypatch.setattr("rse_pf.aws.fleet.group.read_group", lambda *args, **named: fleet)
    stands = Deployment(stacks=dict.fromkeys(STACKS, "CREATE_COMPLETE"), url="ws://robots/ws")
    monkeypatch.setattr("rse_pf.aws.lifecycle.deployment.read_deployment", lambda *args: stands)


def server(name: str, **changes: Any) -> Server:
    facts: dict[str, Any] = {"zone": "a", "state": "InService", "targets": ("healthy",), "robots": 7.0}
    return Server(name=name, **{**facts, **changes})


def test_the_status_of_a_well_fleet(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    show(
        monkeypatch,
        AutoScalingGroup(
            min_servers=1, wanted_servers=1, max_servers=4, servers=(server("i-1"),), alarms={"idle": "OK"}
        ),
    )

    assert main(["cloud", "status"]) == 0

    page = capsys.readouterr().out
    assert page.startswith("rse-pf in ap-northeast-2: up\n")
    assert is_removed("cloud cost") or "\ncosts 0." in page
    assert "ws://robots/ws\n" in page
    assert "1 server, wanted 1 of 1 to 4" in page
    assert "7 robots on 1 server, 7 to 7 on each" in page
    assert "alarm idle         OK\n" in page


def test_servers_that_reported_no_robots_are_not_counted_as_empty(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    both = (server("i-1"), server("i-2", robots=None))
    show(
        monkeypatch, AutoScalingGroup(min_servers=1, wanted_servers=2, max_servers=4, servers=both, alarms={})
    )

    assert main(["cloud", "status"]) == 0

    assert "7 robots on 1 of 2 servers, 7 to 7 on each" in capsys.readouterr().out


def test_the_status_of_an_ill_fleet_leads_to_the_runbook(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ill = server("i-1", targets=("unhealthy",), robots=None)
    show(
        monkeypatch,
        AutoScalingGroup(
            min_servers=1, wanted_servers=1, max_servers=4, servers=(ill,), alarms={"unhealthy": "ALARM"}
        ),
    )

    assert main(["cloud", "status"]) == 1

    page = capsys.readouterr().out
    assert "robots: not reported" in page
    assert "no server has reported" in page
    assert "docs/operations.md#unhealthy" in page
