"""Grant IAM permissions, and record which function of the code makes each call.

`tests/stacks/test_permissions.py` compares the records with the templates: an action that no function needs,
and a function that does not make the call, are both errors.  No other module grants permissions.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import aws_cdk as cdk
from aws_cdk import aws_iam as iam
from constructs import IConstruct

from stacks.findings import acknowledge

__all__ = ["BY_AWS", "LOG_ACTIONS", "USED_BY", "allow", "explain"]

USED_BY = "rse-pf:used-by"
"""Type of the construct metadata that holds the records; the CDK writes it into the assembly's manifest."""
BY_AWS = "aws: "
"""Prefix of ``used_by`` if a service of AWS makes the call itself; the reason follows."""
LOG_ACTIONS = ("logs:CreateLogStream", "logs:PutLogEvents")
"""Actions that the CDK grants to the writers of a log group."""


def allow(
    role: iam.IRole,
    actions: Sequence[str],
    resources: Sequence[str],
    *,
    used_by: str | Sequence[str],
    conditions: Mapping[str, Any] | None = None,
    why: str = "",
) -> None:
    """Allow *role* the *actions* on *resources*, and record which functions make the calls.

    Args:
        role: A role of the same stack.
        actions: Names such as ``s3:GetObject``; no wildcards.
        resources: ARNs, or ``*`` for actions that take no resources.
        used_by: One or more of ``path/of/file.py:function``, ``path/of/file.py:Class.method``, or the path
            alone if the file has one purpose; at least one of them calls each action.  If a service of AWS
            makes the call: `BY_AWS` and the reason.
        conditions: Conditions of the IAM statement.
        why: Reason for which cdk-nag's finding about resources that hold ``*`` is accepted; needed only for
            such resources.
    """
    role.add_to_principal_policy(
        iam.PolicyStatement(
            actions=list(actions), resources=list(resources), conditions=dict(conditions or {})
        )
    )
    explain(role, actions, used_by=used_by)
    if why:
        stack = cdk.Stack.of(role)
        wide = [name for each in resources if "*" in (name := _flat(stack.resolve(each)))]
        acknowledge(role, why, *(f"IAM5[Resource::{name}]" for name in wide))


def explain(role: IConstruct, actions: Sequence[str], *, used_by: str | Sequence[str]) -> None:
    """Record which functions need *actions* that the CDK granted to *role*, or to a role inside *role*.

    *used_by* has the form that `allow` describes.
    """
    users = [used_by] if isinstance(used_by, str) else list(used_by)
    role.node.add_metadata(USED_BY, {"actions": list(actions), "used_by": users})


def _flat(resolved: Any) -> str:
    """Return a resolved ARN, a text or a CloudFormation expression, as cdk-nag writes it in findings."""
    if isinstance(resolved, str):
        return resolved.replace("${", "<").replace("}", ">")
    if "Fn::Join" in resolved:
        between, parts = resolved["Fn::Join"]
        return str(between).join(_flat(each) for each in parts)
    if "Fn::GetAtt" in resolved:
        return f"<{'.'.join(resolved['Fn::GetAtt'])}>"
    for name in ("Fn::ImportValue", "Fn::Sub"):
        if name in resolved:
            return _flat(resolved[name])
    return f"<{resolved['Ref']}>" if "Ref" in resolved else json.dumps(resolved, separators=(",", ":"))
