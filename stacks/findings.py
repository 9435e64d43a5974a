"""Acknowledge findings of cdk-nag, each with a reason."""

from __future__ import annotations

import aws_cdk as cdk
from constructs import IConstruct

__all__ = ["acknowledge"]


def acknowledge(construct: IConstruct, reason: str, *rules: str) -> None:
    """Accept the findings of the AwsSolutions *rules*, such as ``EC23``, at *construct*, with *reason*."""
    cdk.Validations.of(construct).acknowledge(
        *(cdk.Acknowledgment(id=f"AwsSolutions::AwsSolutions-{rule}", reason=reason) for rule in rules)
    )
