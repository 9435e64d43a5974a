"""Check that a deployment was removed: list the resources that AWS still has with its tag.

The check does not rely on the stacks: it reads AWS's tagging service, and finds resources without tags by
their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle.leftovers import find_leftovers
from rse_pf.config.resource_names import DEPLOYMENT_TAG, ResourceNames

__all__ = ["KeptResource", "Proof", "prove"]

# Values of the dimension StorageType whose bucket sizes are added.
_STORAGE_TYPES = (
    "StandardStorage", "StandardIAStorage", "GlacierInstantRetrievalStorage", "GlacierStorage",
    "IntelligentTieringFAStorage", "IntelligentTieringIAStorage",
)  # fmt: skip
# Number of days for which sizes of a bucket are read: AWS publishes them once a day, up to two days late.
_SIZE_WINDOW_DAYS = 3
_DAY_S = 86400
_KEPT_KINDS = {"s3": "bucket", "secretsmanager": "secret"}  # kinds that are kept on purpose, by AWS service
_TERMINATED_STATES = ("terminated", "shutting-down")


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptResource:
    """A bucket or secret that is kept on purpose.

    Attributes:
        kind: ``bucket`` or ``secret``.
        name: Name of the resource.
        gb: Size of a bucket in GB, which AWS measures once a day; None before the first measurement.
    """

    kind: str
    name: str
    gb: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Proof:
    """The resources that are kept on purpose, and the names (``left``) of those that should not exist."""

    kept: tuple[KeptResource, ...]
    left: tuple[str, ...]


def prove(account: Account, names: ResourceNames, *, now: datetime) -> Proof:
    """Return the resources of a deployment that still exist; raises the errors of `Account.find`.

    Args:
        account: AWS account of the deployment.
        names: Names of its resources.
        now: The time in UTC.
    """
    tagged = _list_tagged(account, names)
    kept_names = sorted({(_kind_if_kept(arn), _name(arn)) for arn in tagged if _kind_if_kept(arn)})
    remaining = {arn for arn in tagged if not _kind_if_kept(arn)} - _find_ended_servers(
        account, names, tagged
    )
    remaining |= {
        f"{leftover.kind} {leftover.name}"
        for leftover in find_leftovers(account, names)
        if leftover.kind not in _KEPT_KINDS.values() and not any(leftover.name in arn for arn in tagged)
    }
    kept = (
        KeptResource(kind=kind, name=name, gb=_gigabytes(account, name, now) if kind == "bucket" else 0.0)
        for kind, name in kept_names
    )
    return Proof(kept=tuple(kept), left=tuple(sorted(remaining)))


def _list_tagged(account: Account, names: ResourceNames) -> set[str]:
    rows = account.pages(
        "resourcegroupstaggingapi", "get_resources", "ResourceTagMappingList",
        TagFilters=[{"Key": DEPLOYMENT_TAG, "Values": [names.prefix]}],
    )  # fmt: skip
    data = names.stack("Data")  # this stack costs nothing, and exists as long as the data is kept
    return {str(row["ResourceARN"]) for row in rows if f":stack/{data}/" not in str(row["ResourceARN"])}


def _kind_if_kept(arn: str) -> str:
    return _KEPT_KINDS.get(arn.split(":")[2], "")


def _name(arn: str) -> str:
    return arn.split(":", 5)[5].removeprefix("secret:")


def _find_ended_servers(account: Account, names: ResourceNames, tagged: set[str]) -> set[str]:
    """Return the ARNs of those *tagged* instances that are terminated; AWS lists them for another hour."""
    instances = {arn.rpartition("/")[2]: arn for arn in tagged if ":instance/i-" in arn}
    if not instances:
        return set()
    rows = account.pages(
        "ec2", "describe_instances", "Reservations",
        Filters=[{"Name": f"tag:{DEPLOYMENT_TAG}", "Values": [names.prefix]}],
    )  # fmt: skip
    alive = {
        instance["InstanceId"]
        for row in rows
        for instance in row["Instances"]
        if instance["State"]["Name"] not in _TERMINATED_STATES
    }
    return {arn for name, arn in instances.items() if name not in alive}


def _gigabytes(account: Account, bucket: str, now: datetime) -> float | None:
    """Return the last size of a bucket in GB, which AWS measures once a day; None before the first one."""
    queries = [
        {
            "Id": f"q{at}",
            "MetricStat": {
                "Metric": {
                    "Namespace": "AWS/S3", "MetricName": "BucketSizeBytes",
                    "Dimensions": _dimensions({"BucketName": bucket, "StorageType": kind}),
                },
                "Period": _DAY_S, "Stat": "Average",
            },
        }
        for at, kind in enumerate(_STORAGE_TYPES)
    ]  # fmt: skip
    rows = account.pages(
        "cloudwatch", "get_metric_data", "MetricDataResults", MetricDataQueries=queries,
        ScanBy="TimestampDescending", StartTime=now - timedelta(days=_SIZE_WINDOW_DAYS), EndTime=now,
    )  # fmt: skip
    newest = [row["Values"][0] for row in rows if row["Values"]]
    return sum(newest) / 1e9 if newest else None


def _dimensions(of: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"Name": name, "Value": value} for name, value in of.items()]
