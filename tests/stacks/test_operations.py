"""docs/operations.md: every command is run here, on an emulator, or is marked as needing an account."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.clients import make_client
from rse_pf.cli.main import main
from tests.kit.emulated_aws import NoRoom
from tests.kit.removed_extensions import installed_commands

REGION = "ap-northeast-2"
MARK = "needs an account"

RUN_HERE = {
    "rse-pf cloud cost --robots 20 --fps 5 --hours-per-day 8": 0,
    "rse-pf cloud doctor": 1,
    "rse-pf token init --cloud": 0,
    "rse-pf token issue robot-1 --cloud": 0,
    "rse-pf cloud status": 0,
    "rse-pf token rotate --cloud": 0,
    "rse-pf token retire --cloud --force": 0,
    "rse-pf audit show --cloud --only refused": 2,
    "rse-pf audit show --cloud --only crashed": 2,
    "rse-pf cloud leftovers": 1,
    "rse-pf cloud logs": 1,
    "rse-pf cloud canary": 2,
    "rse-pf cloud cost --robots 20 --fps 5 --burst 100000": 0,
}
"""Each with its exit code on an account that has the Data stack and nothing else."""


@pytest.fixture
def page(repository: Path) -> str:
    """The page."""
    return (repository / "docs" / "operations.md").read_text(encoding="utf-8")


def blocks(page: str) -> list[tuple[str, list[str]]]:
    """Return the paragraph before each fenced block, and the block's commands; JSON is no command."""
    page = re.sub(r"^```json\n.*?^```$", "", page, flags=re.DOTALL | re.MULTILINE)
    found = re.findall(r"((?:[^\n]+\n)+)\n```\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    assert len(found) == page.count("```") // 2, "a block without a paragraph before it"
    return [(" ".join(before.lower().split()), block.splitlines()) for before, block in found]


class Formation:
    """The stack RsePf-Data; moto does not make secrets."""

    def can_paginate(self, method: str) -> bool:
        return False

    def describe_stacks(self, **asked: Any) -> dict[str, Any]:
        return {"Stacks": []}

    def list_stack_resources(self, *, StackName: str) -> dict[str, Any]:
        bucket = "AWS::S3::Bucket"
        kinds = {"SigningKey": "AWS::SecretsManager::Secret", "Artifacts": bucket, "AuditLogs": bucket}
        rows = [
            {"LogicalResourceId": name, "ResourceType": kind, "PhysicalResourceId": name.lower()}
            for name, kind in kinds.items()
        ]
        return {"StackResourceSummaries": rows}


@pytest.fixture
def account(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """An account in this process, with what the Data stack leaves."""
    moto = pytest.importorskip("moto", reason="run make setup")
    monkeypatch.chdir(tmp_path)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    own: dict[str, Any] = {"cloudformation": Formation(), "service-quotas": NoRoom()}
    made = Account(REGION, lambda name, at: own.get(name) or make_client(name, at))
    with moto.mock_aws():
        s3 = make_client("s3", REGION)
        for name in ("artifacts", "auditlogs"):
            s3.create_bucket(Bucket=name, CreateBucketConfiguration={"LocationConstraint": REGION})
        tag = [{"Key": "rse-pf", "Value": "rse-pf"}]
        make_client("secretsmanager", REGION).create_secret(Name="signingkey", SecretString="x", Tags=tag)
        monkeypatch.setattr("rse_pf.aws.account.open_account", lambda region: made)
        yield


def test_what_runs_here_runs_in_the_order_of_the_page(
    page: str, account: None, capsys: pytest.CaptureFixture[str]
) -> None:
    commands = [one for before, block in blocks(page) if MARK not in before for one in block]

    for command in installed_commands(commands):
        code = main(shlex.split(command)[1:])
        told = capsys.readouterr()
        assert code == RUN_HERE[command], f"{command}: {told.err}"
        assert "Traceback" not in told.err
