"""Find the deployment's resources that no existing stack contains: kept on purpose, or forgotten.

Resources of the platform have the tag ``rse-pf`` or a name with one of our prefixes.  Nothing is deleted;
each leftover names the command that deletes it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from rse_pf.aws.account import Account
from rse_pf.aws.cloudformation import list_living_stacks
from rse_pf.config.resource_names import DEPLOYMENT_TAG, ResourceNames
from rse_pf.errors import ConfigurationError

__all__ = ["Leftover", "find_leftovers"]

_FUNCTION_LOG_PREFIX = "/aws/lambda/"  # begins the names of the log groups that Lambda makes by default
_REASONS_KEPT = {
    "bucket": "kept on purpose: holds maps, packages, access logs or audit logs",
    "secret": "kept on purpose: the signing key",
}


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class Leftover:
    """A resource that no stack contains.

    Attributes:
        kind: Kind of the resource, such as ``bucket`` or ``log group``.
        name: Name or id of the resource.
        why: Why it exists: kept on purpose, forgotten, or not readable.
        remove: The command that deletes it.
        unread: Whether its tags could not be read, so that it may belong to another deployment.
    """

    kind: str
    name: str
    why: str
    remove: str
    unread: bool = False


def find_leftovers(account: Account, of: ResourceNames) -> list[Leftover]:
    """Return the resources of the deployment *of* that no existing stack contains, sorted by kind and name.

    Raises the errors of `Account.find`.
    """
    owned = {
        str(row.get("PhysicalResourceId", ""))
        for stack in list_living_stacks(account, of)
        for row in account.pages(
            "cloudformation", "list_stack_resources", "StackResourceSummaries", StackName=stack
        )
    }
    unread: dict[str, str] = {}
    leftovers = {
        (kind, name)
        for kind, name, alias in _list_resources(account, of, unread)
        if not owned & {name, alias}
    }
    return sorted(
        Leftover(
            kind=kind, name=name, remove=_removal_command(kind, name), unread=name in unread,
            why=unread.get(name) or _REASONS_KEPT.get(kind, "forgotten"),
        )
        for kind, name in leftovers
    )  # fmt: skip


def _list_resources(
    account: Account, of: ResourceNames, unread: dict[str, str]
) -> Iterator[tuple[str, str, str]]:
    """Yield kind and name of each resource of the deployment, and its ARN if CloudFormation may use that.

    Write the names of buckets whose tags cannot be read into *unread*, with the reason.
    """
    for row in account.pages("s3", "list_buckets", "Buckets"):
        try:
            is_ours = _is_tagged(account, of, row["Name"])
        except ConfigurationError as error:
            unread[row["Name"]] = f"perhaps not ours, its tags cannot be read: {error.message}"
            is_ours = True
        if is_ours:
            yield "bucket", row["Name"], ""
    for row in account.pages("secretsmanager", "list_secrets", "SecretList"):
        if _has_tag(of, row.get("Tags", ())):
            yield "secret", row["Name"], row["ARN"]
    for before in ("", _FUNCTION_LOG_PREFIX):
        prefix = f"{before}{of.stack_prefix}"
        for row in account.pages("logs", "describe_log_groups", "logGroups", logGroupNamePrefix=prefix):
            if of.owns_stack(row["logGroupName"].removeprefix(before)):
                yield "log group", row["logGroupName"], ""
    for row in account.pages(
        "cloudwatch", "describe_alarms", "MetricAlarms", AlarmNamePrefix=of.alarm_prefix
    ):
        yield "alarm", row["AlarmName"], row["AlarmArn"]
    tagged: list[dict[str, Any]] = [{"Name": f"tag:{DEPLOYMENT_TAG}", "Values": [of.prefix]}]
    unattached = [*tagged, {"Name": "status", "Values": ["available"]}]
    for row in account.pages("ec2", "describe_volumes", "Volumes", Filters=unattached):
        yield "volume", row["VolumeId"], ""
    for row in account.pages("ec2", "describe_network_interfaces", "NetworkInterfaces", Filters=unattached):
        yield "network interface", row["NetworkInterfaceId"], ""


def _is_tagged(account: Account, of: ResourceNames, bucket: str) -> bool:
    answer = account.find("s3", "get_bucket_tagging", Bucket=bucket) or {}
    if not _has_tag(of, answer.get("TagSet", ())):
        return False
    # Buckets of all regions are listed, and another region may have a deployment of the same name.
    where = account.find("s3", "get_bucket_location", Bucket=bucket) or {}
    return (where.get("LocationConstraint") or "us-east-1") == account.region


def _has_tag(of: ResourceNames, tags: Iterable[dict[str, Any]]) -> bool:
    return any(tag["Key"] == DEPLOYMENT_TAG and tag["Value"] == of.prefix for tag in tags)


def _removal_command(kind: str, name: str) -> str:
    commands = {
        "bucket": f"empty it in the console, all versions; then aws s3api delete-bucket --bucket {name}",
        "secret": f"aws secretsmanager delete-secret --secret-id {name}",
        "log group": f"aws logs delete-log-group --log-group-name {name}",
        "alarm": f"aws cloudwatch delete-alarms --alarm-names {name}",
        "volume": f"aws ec2 delete-volume --volume-id {name}",
        "network interface": f"aws ec2 delete-network-interface --network-interface-id {name}",
    }
    return commands[kind]
