"""Prove that a deployment is gone: what AWS still lists under its tag, and what that costs.

The proof does not rely on the stacks: it asks the tagging service, and looks for what cannot be tagged by
name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta

from rse_pf.aws.account import Account
from rse_pf.aws.money.leftovers import find_leftovers
from rse_pf.aws.money.prices import Prices
from rse_pf.config.resource_names import DEPLOYMENT_TAG, ResourceNames

__all__ = ["KeptResource", "Proof", "prove"]

_CLASSES = (
    "StandardStorage", "StandardIAStorage", "GlacierInstantRetrievalStorage", "GlacierStorage",
    "IntelligentTieringFAStorage", "IntelligentTieringIAStorage",
)  # fmt: skip
_SIZE_DAYS = 3
_DAY_S = 86400
_KEPT_SERVICES = {"s3": "bucket", "secretsmanager": "secret"}
_ENDED = ("terminated", "shutting-down")


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptResource:
    """What is kept on purpose; ``gb`` is None as long as AWS has not measured it (once a day)."""

    kind: str
    name: str
    gb: float | None
    per_month: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Proof:
    """What is kept, and the names of what is left although nobody wants it."""

    kept: tuple[KeptResource, ...]
    left: tuple[str, ...]

    @property
    def per_month(self) -> float:
        """Return what all that is kept costs a month, as far as it is measured."""
        return sum(each.per_month for each in self.kept)


def prove(account: Account, names: ResourceNames, prices: Prices, *, now: datetime) -> Proof:
    """Return what there still is of a deployment at *now*, in UTC; raises as `Account.find`."""
    tagged = _list_tagged(account, names)
    kept_names = sorted({(_kind_if_kept(arn), _name(arn)) for arn in tagged if _kind_if_kept(arn)})
    remaining = {arn for arn in tagged if not _kind_if_kept(arn)} - _find_ended_servers(account, tagged)
    remaining |= {
        f"{leftover.kind} {leftover.name}"
        for leftover in find_leftovers(account, names)
        if leftover.kind not in _KEPT_SERVICES.values() and not any(leftover.name in arn for arn in tagged)
    }
    resources = []
    for kind, name in kept_names:
        gb = _gigabytes(account, name, now) if kind == "bucket" else 0.0
        price = prices.stored_per_gb_month * (gb or 0.0) if kind == "bucket" else prices.secret_per_month
        resources.append(KeptResource(kind=kind, name=name, gb=gb, per_month=price))
    return Proof(kept=tuple(resources), left=tuple(sorted(remaining)))


def _list_tagged(account: Account, names: ResourceNames) -> set[str]:
    rows = account.pages(
        "resourcegroupstaggingapi", "get_resources", "ResourceTagMappingList",
        TagFilters=[{"Key": DEPLOYMENT_TAG, "Values": [names.prefix]}],
    )  # fmt: skip
    data = names.stack("Data")  # the stack itself costs nothing, and stands as long as the data is kept
    return {str(row["ResourceARN"]) for row in rows if f":stack/{data}/" not in str(row["ResourceARN"])}


def _kind_if_kept(arn: str) -> str:
    return _KEPT_SERVICES.get(arn.split(":")[2], "")


def _name(arn: str) -> str:
    return arn.split(":", 5)[5].removeprefix("secret:")


def _find_ended_servers(account: Account, tagged: set[str]) -> set[str]:
    """Return the instances that are listed for an hour after their end."""
    instances = {arn.rpartition("/")[2]: arn for arn in tagged if ":instance/i-" in arn}
    if not instances:
        return set()
    rows = account.pages(
        "ec2", "describe_instances", "Reservations",
        Filters=[{"Name": "instance-id", "Values": sorted(instances)[:200]}],
    )  # fmt: skip
    alive = {
        instance["InstanceId"]
        for row in rows
        for instance in row["Instances"]
        if instance["State"]["Name"] not in _ENDED
    }
    return {arn for name, arn in instances.items() if name not in alive}


def _gigabytes(account: Account, bucket: str, now: datetime) -> float | None:
    """Return the size of a bucket as AWS measures it once a day; None if it did not yet."""
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
        for at, kind in enumerate(_CLASSES)
    ]  # fmt: skip
    rows = account.pages(
        "cloudwatch", "get_metric_data", "MetricDataResults", MetricDataQueries=queries,
        ScanBy="TimestampDescending", StartTime=now - timedelta(days=_SIZE_DAYS), EndTime=now,
    )  # fmt: skip
    newest = [row["Values"][0] for row in rows if row["Values"]]
    return sum(newest) / 1e9 if newest else None


def _dimensions(of: Mapping[str, str]) -> list[dict[str, str]]:
    return [{"Name": name, "Value": value} for name, value in of.items()]
