"""What the tests of several verbs share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.clients import make_client
from rse_pf.local.firewall import ensure_key
from tests.kit.emulated_aws import REGION, emulated_aws


@pytest.fixture
def platform(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a platform that has run once; the working folder is a robot's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    folder = tmp_path / "rse-pf" / "default"
    folder.mkdir(parents=True)
    ensure_key(folder, seed=b"s" * 32, key_id="k")
    return folder


ROWS = (
    ("SigningKey8FF1", "AWS::SecretsManager::Secret", "signing-key"),
    ("Artifacts1F2E", "AWS::S3::Bucket", "artifacts"),
    ("AuditLogs3C4D", "AWS::S3::Bucket", "audit-logs"),
    ("Maps5E6F", "AWS::S3::Bucket", "maps"),
)


class Formation:
    """The stack RsePf-Data, as far as its secret and its buckets; moto does not make secrets."""

    def can_paginate(self, method: str) -> bool:
        return False

    def list_stack_resources(self, *, StackName: str) -> dict[str, Any]:
        names = ("LogicalResourceId", "ResourceType", "PhysicalResourceId")
        return {"StackResourceSummaries": [dict(zip(names, row, strict=True)) for row in ROWS]}


@pytest.fixture
def cloud(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A deployment without keys; the S3 client that sees its buckets."""
    monkeypatch.chdir(tmp_path)
    with emulated_aws(monkeypatch, request.node.nodeid):
        s3 = make_client("s3", REGION)
        for name in ("artifacts", "audit-logs", "maps"):
            s3.create_bucket(Bucket=name, CreateBucketConfiguration={"LocationConstraint": REGION})
        make_client("secretsmanager", REGION).create_secret(Name="signing-key", SecretString="k]:vE{")
        account = Account(
            REGION, lambda name, at: Formation() if name == "cloudformation" else make_client(name, at)
        )
        monkeypatch.setattr("rse_pf.aws.account.open_account", lambda region: account)
        yield s3
