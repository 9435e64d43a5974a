"""Acknowledge a finding of cdk-nag, never without a reason."""

from __future__ import annotations

import aws_cdk as cdk
from constructs import IConstruct

__all__ = ["acknowledge"]


def acknowledge(construct: IConstruct, reason: str, *rules: str) -> None:
    """Accept the findings *rules* of AwsSolutions at *construct*, because of *reason*."""
    cdk.Validations.of(construct).acknowledge(
        *(cdk.Acknowledgment(id=f"AwsSolutions::AwsSolutions-{rule}", reason=reason) for rule in rules)
    )
