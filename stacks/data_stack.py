"""Buckets and the signing key: they stay when the stack is deleted, and are hard to delete.

To delete the data, an operator turns termination protection off and then empties the buckets by hand.
Audit logs also need a role that may bypass their retention.
"""

from __future__ import annotations

import aws_cdk as cdk
from aws_cdk import aws_s3 as s3
from aws_cdk import aws_secretsmanager as secretsmanager
from constructs import Construct

from rse_pf.config import PlatformSettings
from stacks.findings import acknowledge

__all__ = ["DataStack"]

_INFREQUENT_AFTER_DAYS = 30
"""The soonest that S3 takes an object there; ``data.glacier_after_days`` is not less."""


class DataStack(cdk.Stack):
    """Map, artifact, audit-log and access-log buckets; the secret of the signing key."""

    def __init__(
        self, scope: Construct, construct_id: str, *, settings: PlatformSettings, env: cdk.Environment
    ) -> None:
        super().__init__(scope, construct_id, env=env, termination_protection=True)
        self.access_logs = self._bucket("AccessLogs", None)
        self.access_logs.add_lifecycle_rule(expiration=cdk.Duration.days(settings.cloud.log_days))
        self.maps = self._bucket("Maps", self.access_logs)
        self.maps.add_lifecycle_rule(
            transitions=[
                s3.Transition(storage_class=kind, transition_after=cdk.Duration.days(days))
                for kind, days in (
                    (s3.StorageClass.INFREQUENT_ACCESS, _INFREQUENT_AFTER_DAYS),
                    (s3.StorageClass.GLACIER, settings.data.glacier_after_days),
                )
            ],
            abort_incomplete_multipart_upload_after=cdk.Duration.days(1),
        )
        self.artifacts = self._bucket("Artifacts", self.access_logs)
        self.audit_logs = self._bucket(
            "AuditLogs", self.access_logs, cdk.Duration.days(settings.cloud.audit_days)
        )
        self.audit_logs.add_lifecycle_rule(
            expiration=cdk.Duration.days(settings.cloud.audit_days + 1),
            noncurrent_version_expiration=cdk.Duration.days(1),
        )
        self.signing_key = secretsmanager.Secret(
            self, "SigningKey", description="private half of the robots' tokens; rse-pf token init --cloud",
            removal_policy=cdk.RemovalPolicy.RETAIN,
        )  # fmt: skip
        acknowledge(self.signing_key, "rotated by two overlapping keys, see docs/operations.md", "SMG4")

    def _bucket(self, name: str, logs: s3.Bucket | None, locked_for: cdk.Duration | None = None) -> s3.Bucket:
        lock = None if locked_for is None else s3.ObjectLockRetention.governance(locked_for)
        return s3.Bucket(
            self, name, versioned=True, encryption=s3.BucketEncryption.S3_MANAGED, enforce_ssl=True,
            block_public_access=s3.BlockPublicAccess.BLOCK_ALL, removal_policy=cdk.RemovalPolicy.RETAIN,
            object_ownership=s3.ObjectOwnership.BUCKET_OWNER_ENFORCED,
            object_lock_enabled=None if lock is None else True, object_lock_default_retention=lock,
            server_access_logs_bucket=logs, server_access_logs_prefix=f"{name.lower()}/" if logs else None,
        )  # fmt: skip
