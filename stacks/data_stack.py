"""The data servers' ground: buckets and the signing key; kept when the stack goes, and hard to delete.

Whoever wants the data gone turns two keys: termination protection off, then the buckets emptied by hand.
"""

from __future__ import annotations

import aws_cdk as cdk
from aws_cdk import aws_s3 as s3
from aws_cdk import aws_secretsmanager as secretsmanager
from constructs import Construct

from rse_pf.settings import PlatformSettings
from stacks.findings import acknowledge

__all__ = ["DataStack"]


class DataStack(cdk.Stack):
    """Map, artifact and access-log buckets; the secret of the signing key."""

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
                    (s3.StorageClass.INFREQUENT_ACCESS, settings.data.infrequent_after_days),
                    (s3.StorageClass.GLACIER, settings.data.glacier_after_days),
                )
            ]
        )
        self.artifacts = self._bucket("Artifacts", self.access_logs)
        self.signing_key = secretsmanager.Secret(
            self, "SigningKey", description="private half of the robots' tokens; rse-pf token init --cloud",
            removal_policy=cdk.RemovalPolicy.RETAIN,
        )  # fmt: skip
        acknowledge(self.signing_key, "rotated by two overlapping keys, see docs/operations.md", "SMG4")

    def _bucket(self, name: str, logs: s3.Bucket | None) -> s3.Bucket:
        return s3.Bucket(
            self, name, versioned=True, encryption=s3.BucketEncryption.S3_MANAGED, enforce_ssl=True,
            block_public_access=s3.BlockPublicAccess.BLOCK_ALL, removal_policy=cdk.RemovalPolicy.RETAIN,
            object_ownership=s3.ObjectOwnership.BUCKET_OWNER_ENFORCED,
            server_access_logs_bucket=logs, server_access_logs_prefix=f"{name.lower()}/" if logs else None,
        )  # fmt: skip
