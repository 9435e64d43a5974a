"""rse-pf cloud canary on an emulated account."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.aws.account import open_account
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings

REGION = PlatformSettings().cloud.region


@pytest.fixture
def account(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Any]:
    moto = pytest.importorskip("moto", reason="run make setup")
    monkeypatch.chdir(tmp_path)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    with moto.mock_aws():
        made = open_account(REGION)
        where = {"LocationConstraint": REGION}
        made.client("s3").create_bucket(Bucket="artifacts", CreateBucketConfiguration=where)
        for name in ("signingkey", "canarykey"):
            made.client("secretsmanager").create_secret(Name=name, SecretString="x")
        monkeypatch.setattr(type(made), "resource", lambda self, stack, kind, prefix: prefix.lower())
        monkeypatch.setattr("rse_pf.aws.account.open_account", lambda region: made)
        yield made


def test_the_canary_gets_a_key_and_is_enrolled_as_a_synthetic_robot_that_may_ask_for_poses(
    account: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["cloud", "canary"]) == 0
    first = account.client("secretsmanager").get_secret_value(SecretId="canarykey")["SecretString"]
    assert main(["cloud", "canary"]) == 0

    told = account.client("secretsmanager").get_secret_value(SecretId="canarykey")["SecretString"]
    (robot,) = AccessControlStore(S3Store(account.client("s3"), "artifacts")).roster().robots
    assert (robot.robot, robot.scopes) == ("rse-pf-canary", ("services:pnp", "synthetic"))
    assert robot.key_id == SigningKey.from_json(told).key_id != SigningKey.from_json(first).key_id
    assert json.loads(told)["d"] not in capsys.readouterr().out


def test_a_canary_whose_secret_is_gone_is_not_enrolled(
    account: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "canarykey"
    account.client("secretsmanager").delete_secret(SecretId=name, ForceDeleteWithoutRecovery=True)

    assert main(["cloud", "canary"]) == 2

    assert "put_secret_value: the resource does not exist" in capsys.readouterr().err
    assert AccessControlStore(S3Store(account.client("s3"), "artifacts")).roster().robots == ()


def test_a_canary_that_is_off_is_not_enrolled(
    account: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    context = {"rse-pf": {"cloud": {"canary": False}}}
    (tmp_path / "cdk.json").write_text(json.dumps({"context": context}), encoding="utf-8")

    assert main(["cloud", "canary"]) == 2
    assert "cloud.canary is off" in capsys.readouterr().err
