"""Read the stacks of a deployment, and the version of the CDK's bootstrap.

Nothing is changed.
"""

from __future__ import annotations

from typing import Any

from rse_pf.aws.account import Account
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames

__all__ = ["bootstrap_version", "living_stacks"]

_GONE = ("DELETE_COMPLETE", "REVIEW_IN_PROGRESS")


def living_stacks(account: Account, of: ResourceNames) -> dict[str, dict[str, Any]]:
    """Return the stacks of the deployment *of* that exist, by name; raises as `Account.find`."""
    rows = account.pages("cloudformation", "describe_stacks", "Stacks")
    found = {row["StackName"]: row for row in rows if row["StackStatus"] not in _GONE}
    return {name: found[name] for name in sorted(found) if of.owns_stack(name)}


def bootstrap_version(account: Account, settings: PlatformSettings) -> str | None:
    """Return the version of the CDK's bootstrap, None without one; raises as `Account.find`."""
    name = f"/cdk-bootstrap/{settings.cloud.bootstrap_qualifier}/version"
    found = account.find("ssm", "get_parameter", Name=name)
    return None if found is None else str(found["Parameter"]["Value"])
