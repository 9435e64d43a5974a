"""Read the stacks of a deployment, and the version of the CDK's bootstrap; change nothing."""

from __future__ import annotations

from typing import Any

from rse_pf.aws.account import Account
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames, toolkit_stack

__all__ = ["find_foreign_qualifier", "list_living_stacks", "read_bootstrap_version"]

# States of stacks that do not exist: deleted, or never created because only a change set was made.
_NOT_EXISTING = ("DELETE_COMPLETE", "REVIEW_IN_PROGRESS")


def list_living_stacks(account: Account, of: ResourceNames) -> dict[str, dict[str, Any]]:
    """Return the existing stacks of the deployment *of*, as AWS describes them, by name and sorted.

    Raises the errors of `Account.find`.
    """
    rows = account.pages("cloudformation", "describe_stacks", "Stacks")
    living = {row["StackName"]: row for row in rows if row["StackStatus"] not in _NOT_EXISTING}
    return {name: living[name] for name in sorted(living) if of.owns_stack(name)}


def read_bootstrap_version(account: Account, settings: PlatformSettings) -> str | None:
    """Return the version of the CDK's bootstrap with our qualifier; None if there is none.

    Raises the errors of `Account.find`.
    """
    name = f"/cdk-bootstrap/{settings.cloud.bootstrap_qualifier}/version"
    parameter = account.find("ssm", "get_parameter", Name=name)
    return None if parameter is None else str(parameter["Parameter"]["Value"])


def find_foreign_qualifier(account: Account, settings: PlatformSettings) -> str | None:
    """Return the qualifier of the existing bootstrap stack with our stack's name, if it is not our qualifier.

    A bootstrap would then overwrite the bootstrap of other applications.  None if there is no such stack, or
    if it has our qualifier.  Raises the errors of `Account.find`.
    """
    ours = settings.cloud.bootstrap_qualifier
    answer = account.find("cloudformation", "describe_stacks", StackName=toolkit_stack(ours))
    stacks = answer["Stacks"] if answer else ()
    qualifiers = [
        str(parameter["ParameterValue"])
        for stack in stacks
        if stack["StackStatus"] not in _NOT_EXISTING
        for parameter in stack.get("Parameters", ())
        if parameter["ParameterKey"] == "Qualifier"
    ]
    return qualifiers[0] if qualifiers and qualifiers[0] != ours else None
