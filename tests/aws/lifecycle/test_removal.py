"""Deleted data is gone, and what is not deleted is told or ends the command."""

from __future__ import annotations

from datetime import datetime, timezone
from typing import Any

import pytest

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle import removal
from rse_pf.aws.lifecycle.leftovers import Leftover
from rse_pf.aws.lifecycle.plan import Step
from rse_pf.aws.lifecycle.removal import erase_data
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError
from tests.kit.account_on_moto import NAMES, Killer, account_of

CREATED = datetime(2026, 11, 1, tzinfo=timezone.utc)


class Refusing:
    """S3 with one object in each bucket, which it does not delete."""

    def __init__(self, code: str) -> None:
        self.code = code
        self.deleted: list[str] = []

    def list_object_versions(self, Bucket: str) -> dict[str, Any]:
        return {"Versions": [{"Key": "k", "VersionId": "1", "LastModified": CREATED}]}

    def delete_objects(self, Bucket: str, Delete: dict[str, Any]) -> dict[str, Any]:
        return {"Errors": [{"Key": "k", "VersionId": "1", "Code": self.code}]}

    def delete_bucket(self, Bucket: str) -> dict[str, Any]:
        self.deleted.append(Bucket)
        return {}


def erased(monkeypatch: pytest.MonkeyPatch, bucket: str, *, code: str, deployment: str = "") -> list[str]:
    left = Leftover(kind="bucket", name=bucket, why="", remove="")
    monkeypatch.setattr(removal, "find_leftovers", lambda account, names: [left])
    account = Account("ap-northeast-2", lambda service, region: Refusing(code))
    return erase_data(account, ResourceNames(deployment), audit_days=90)


def test_audit_logs_that_are_locked_stay_and_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = erased(monkeypatch, "rsepf-data-auditlogs12ab-x1", code="AccessDenied")

    assert line == (
        "rsepf-data-auditlogs12ab-x1 stays: object lock keeps 1 audit logs, the last until 2027-01-30"
    )


@pytest.mark.parametrize(
    ("bucket", "code", "deployment"),
    [
        ("rsepf-data-maps12ab-x1", "AccessDenied", ""),
        ("rsepf-data-artifacts12ab-x1", "AccessDenied", ""),
        ("rsepf-auditlogs-data-maps12ab-x1", "AccessDenied", "auditlogs"),
        ("rsepf-data-auditlogs12ab-x1", "InternalError", ""),
    ],
)
def test_data_that_is_not_deleted_for_another_reason_ends_the_command(
    monkeypatch: pytest.MonkeyPatch, bucket: str, code: str, deployment: str
) -> None:
    with pytest.raises(ConfigurationError, match=f"delete objects of {bucket}: {code}") as told:
        erased(monkeypatch, bucket, code=code, deployment=deployment)
    assert "permissions" in told.value.hint


def test_the_signing_key_can_be_restored_and_the_step_says_so(region: str) -> None:
    account = account_of(region, Killer())
    secrets = account.client("secretsmanager")
    kept = secrets.create_secret(
        Name="signing-key", SecretString="x", Tags=[{"Key": "rse-pf", "Value": NAMES.prefix}]
    )

    erase_data(account, NAMES, audit_days=1)

    assert str(Step("erase")).endswith("the signing key, which AWS can restore for 30 days")
    found = secrets.describe_secret(SecretId=kept["ARN"])
    assert (found["DeletedDate"] - datetime.now(timezone.utc)).days >= 29
