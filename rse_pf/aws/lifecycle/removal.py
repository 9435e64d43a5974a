"""Delete resources that outlive the stacks: forgotten ones and, if the operator agrees, the data.

Object lock is respected: an audit log that is still locked stays, and so does its bucket.  AWS can restore a
secret for 30 days after its deletion.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime, timedelta
from typing import Any

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle.leftovers import Leftover, find_leftovers
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError

__all__ = ["erase_data", "sweep"]

# Objects of one call that deletes: the most that S3 takes.
_OBJECTS_OF_A_CALL = 1000


def sweep(account: Account, names: ResourceNames) -> None:
    """Delete the resources that no stack owns and that are not kept on purpose; raises as `Account.find`."""
    for leftover in find_leftovers(account, names):
        if leftover.kind in _SWEPT and not leftover.unread:
            service, method, argument = _SWEPT[leftover.kind]
            value: Any = [leftover.name] if argument == "AlarmNames" else leftover.name
            account.find(service, method, **{argument: value})


def erase_data(account: Account, names: ResourceNames, *, audit_days: int) -> list[str]:
    """Delete the buckets and secrets that no stack owns; return a line for each bucket that has to stay.

    Raises:
        ConfigurationError: AWS refused.
        StoreError: AWS does not answer.
    """
    refused = []
    for leftover in sorted(find_leftovers(account, names), key=_deletion_order):
        if leftover.unread:
            continue
        if leftover.kind == "secret":
            account.find("secretsmanager", "delete_secret", SecretId=leftover.name)
        elif leftover.kind == "bucket":
            has_lock = _AUDIT_LOGS in leftover.name.removeprefix(names.stack("Data").lower())
            locked, until = _empty_bucket(account, leftover.name, audit_days, has_lock=has_lock)
            if locked:
                logs = f"object lock keeps {locked} audit logs, the last until {until:%Y-%m-%d}"
                refused.append(f"{leftover.name} stays: {logs}")
            else:
                account.find("s3", "delete_bucket", Bucket=leftover.name)
    return refused


_SWEPT = {
    "log group": ("logs", "delete_log_group", "logGroupName"),
    "alarm": ("cloudwatch", "delete_alarms", "AlarmNames"),
    "volume": ("ec2", "delete_volume", "VolumeId"),
    "network interface": ("ec2", "delete_network_interface", "NetworkInterfaceId"),
}


def _deletion_order(leftover: Leftover) -> tuple[bool, str]:
    """Return a key that sorts the bucket into which the others write to the end."""
    return "accesslogs" in leftover.name, leftover.name


def _empty_bucket(account: Account, bucket: str, audit_days: int, *, has_lock: bool) -> tuple[int, datetime]:
    """Delete every version of every object; return how many are locked, and until when the last one is.

    S3 answers alike for a locked object and for one that the account may not delete; *has_lock* decides.
    """
    locked, until = 0, datetime.min
    for page in _pages_of_versions(account, bucket):
        dates = {row["Key"]: row["LastModified"] for row in reversed(page)}
        for at in range(0, len(page), _OBJECTS_OF_A_CALL):
            some = [
                {"Key": row["Key"], "VersionId": row["VersionId"]}
                for row in page[at : at + _OBJECTS_OF_A_CALL]
            ]
            deletion = {"Objects": some, "Quiet": True}
            answer = account.find("s3", "delete_objects", Bucket=bucket, Delete=deletion)
            for error in (answer or {}).get("Errors", ()):
                if not (has_lock and error["Code"] in _LOCKED):
                    raise ConfigurationError(
                        f"AWS refuses to delete objects of {bucket}: {error['Code']}",
                        hint="check your account's permissions, or sign in again",
                    )
                locked += 1
                locked_until = dates[error["Key"]] + timedelta(days=audit_days)
                until = max(until, locked_until.replace(tzinfo=None))
    return locked, until


_LOCKED = ("AccessDenied", "AccessForbidden")
_AUDIT_LOGS = "auditlogs"
"""In the name of the only bucket with object lock, after that of its stack."""


def _pages_of_versions(account: Account, bucket: str) -> Iterator[list[dict[str, Any]]]:
    marker: dict[str, str] = {}
    while True:
        page = account.find("s3", "list_object_versions", Bucket=bucket, **marker)
        if page is None:
            return
        yield [*page.get("Versions", ()), *page.get("DeleteMarkers", ())]
        if not page.get("IsTruncated"):
            return
        marker = {"KeyMarker": page["NextKeyMarker"], "VersionIdMarker": page["NextVersionIdMarker"]}
