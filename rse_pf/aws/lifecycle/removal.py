"""Delete resources that remain after the stacks: forgotten ones and, if the operator agrees, the data.

An audit log that object lock still protects stays, and so does its bucket.  AWS can restore a secret for
30 days after its deletion.
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

# Most objects that one call deletes: S3 takes no more.
_MAX_OBJECTS_PER_CALL = 1000


def sweep(account: Account, names: ResourceNames) -> None:
    """Delete log groups, alarms, volumes and network interfaces of the deployment that no stack contains.

    Raises the errors of `Account.find`.
    """
    for leftover in find_leftovers(account, names):
        if leftover.kind in _DELETE_CALLS and not leftover.unread:
            service, method, argument = _DELETE_CALLS[leftover.kind]
            value: Any = [leftover.name] if argument == "AlarmNames" else leftover.name
            account.find(service, method, **{argument: value})


def erase_data(account: Account, names: ResourceNames, *, audit_days: int) -> list[str]:
    """Delete the deployment's buckets and secrets that no stack contains.

    Return a line for each bucket that has to stay because object lock protects audit logs in it.

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
            has_lock = _AUDIT_LOGS_NAME in leftover.name.removeprefix(names.stack("Data").lower())
            locked, until = _empty_bucket(account, leftover.name, audit_days, has_lock=has_lock)
            if locked:
                logs = f"object lock keeps {locked} audit logs, the last until {until:%Y-%m-%d}"
                refused.append(f"{leftover.name} stays: {logs}")
            else:
                account.find("s3", "delete_bucket", Bucket=leftover.name)
    return refused


# Service, method and argument of the call that deletes a resource, by its kind.
_DELETE_CALLS = {
    "log group": ("logs", "delete_log_group", "logGroupName"),
    "alarm": ("cloudwatch", "delete_alarms", "AlarmNames"),
    "volume": ("ec2", "delete_volume", "VolumeId"),
    "network interface": ("ec2", "delete_network_interface", "NetworkInterfaceId"),
}


def _deletion_order(leftover: Leftover) -> tuple[bool, str]:
    """Return a sort key that puts the bucket of access logs last, because the other buckets write into it."""
    return "accesslogs" in leftover.name, leftover.name


def _empty_bucket(account: Account, bucket: str, audit_days: int, *, has_lock: bool) -> tuple[int, datetime]:
    """Delete every version of every object in *bucket*.

    Return the number of versions that are locked, and the time (UTC) until which the last of them is locked.
    S3 gives the same error for a locked object and for one that the account may not delete: it means a lock
    if *has_lock*, else ConfigurationError is raised.
    """
    locked, until = 0, datetime.min
    for page in _pages_of_versions(account, bucket):
        dates = {row["Key"]: row["LastModified"] for row in reversed(page)}
        for at in range(0, len(page), _MAX_OBJECTS_PER_CALL):
            some = [
                {"Key": row["Key"], "VersionId": row["VersionId"]}
                for row in page[at : at + _MAX_OBJECTS_PER_CALL]
            ]
            deletion = {"Objects": some, "Quiet": True}
            answer = account.find("s3", "delete_objects", Bucket=bucket, Delete=deletion)
            for error in (answer or {}).get("Errors", ()):
                if not (has_lock and error["Code"] in _LOCK_ERRORS):
                    raise ConfigurationError(
                        f"AWS refuses to delete objects of {bucket}: {error['Code']}",
                        hint="check your account's permissions, or sign in again",
                    )
                locked += 1
                locked_until = dates[error["Key"]] + timedelta(days=audit_days)
                until = max(until, locked_until.replace(tzinfo=None))
    return locked, until


_LOCK_ERRORS = ("AccessDenied", "AccessForbidden")  # error codes of S3 for an object that is locked
_AUDIT_LOGS_NAME = "auditlogs"
"""Part of the name of the only bucket with object lock, after the name of its stack."""


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
