"""The data stack: buckets and the signing key, which are retained when the stack is deleted.

To delete the data, an operator calls ``rse-pf cloud down --delete-data``, or turns termination protection off
and empties the buckets by hand.  Audit logs that are still locked can only be deleted by a role that may
bypass their retention.
"""

from __future__ import annotations

import aws_cdk as cdk
from aws_cdk import aws_iam as iam
from aws_cdk import aws_s3 as s3
from aws_cdk import aws_secretsmanager as secretsmanager
from aws_cdk import region_info
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import DELETED_DAYS, LOG_DAYS
from rse_pf.config.resource_names import JOURNAL_PREFIX, ResourceNames
from stacks.findings import acknowledge
from stacks.replication import Replication
from stacks.values import provide

__all__ = ["BALANCER_LOGS", "DataStack"]

BALANCER_LOGS = "alb"
"""Prefix of the load balancer's access logs in their bucket."""

_DAY = cdk.Duration.days(1)
_FREQUENTLY_WRITTEN = ("live/", "jobs/", "accounts/")
"""Prefixes of leases and accounts, which change up to twice a second: old versions are kept for a day."""
# Days after which a map or object moves to the class Infrequent Access: the least that S3 allows.
_INFREQUENT_AFTER_DAYS = 30
# Days after which it moves to Glacier Instant Retrieval, which needs no restore before a read (Sect. 5.1).
_GLACIER_AFTER_DAYS = 90


class DataStack(cdk.Stack):
    """The stack with the buckets of maps, artifacts, audit logs and access logs, and the signing key.

    It provides the buckets' names for other stacks as ``data/maps``, ``data/artifacts``, ``data/audit-logs``
    and ``data/access-logs``.
    """

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: PlatformSettings,
        env: cdk.Environment,
        synthesizer: cdk.IStackSynthesizer | None = None,
    ) -> None:
        super().__init__(scope, construct_id, env=env, synthesizer=synthesizer, termination_protection=True)
        deleted = cdk.Duration.days(DELETED_DAYS)
        self.access_logs = self._bucket("AccessLogs", None)
        self.access_logs.add_lifecycle_rule(
            expiration=cdk.Duration.days(LOG_DAYS),
            noncurrent_version_expiration=_DAY, abort_incomplete_multipart_upload_after=_DAY,
        )  # fmt: skip
        self.maps = self._bucket("Maps", self.access_logs)
        self.maps.add_lifecycle_rule(
            transitions=[
                s3.Transition(storage_class=kind, transition_after=cdk.Duration.days(days))
                for kind, days in (
                    (s3.StorageClass.INFREQUENT_ACCESS, _INFREQUENT_AFTER_DAYS),
                    (s3.StorageClass.GLACIER_INSTANT_RETRIEVAL, _GLACIER_AFTER_DAYS),
                )
            ],
        )
        for prefix in _FREQUENTLY_WRITTEN:
            self.maps.add_lifecycle_rule(prefix=prefix, noncurrent_version_expiration=_DAY)
        self.artifacts = self._bucket("Artifacts", self.access_logs)
        for bucket in (self.maps, self.artifacts):
            bucket.add_lifecycle_rule(
                noncurrent_version_expiration=deleted, expired_object_delete_marker=True,
                abort_incomplete_multipart_upload_after=_DAY,
            )  # fmt: skip
        self.artifacts.add_lifecycle_rule(
            prefix=f"{JOURNAL_PREFIX}/", expiration=cdk.Duration.days(LOG_DAYS)
        )  # fmt: skip
        self.audit_logs = self._bucket(
            "AuditLogs", self.access_logs, cdk.Duration.days(settings.cloud.audit_days)
        )
        self.audit_logs.add_lifecycle_rule(
            expiration=cdk.Duration.days(settings.cloud.audit_days + 1),
            noncurrent_version_expiration=_DAY, abort_incomplete_multipart_upload_after=_DAY,
        )  # fmt: skip
        if settings.cloud.replica_artifacts or settings.cloud.replica_maps:
            Replication(self, "Replication", artifacts=self.artifacts, maps=self.maps, settings=settings)
        self.signing_key = secretsmanager.Secret(
            self, "SigningKey", description="private half of the robots' tokens; rse-pf token init --cloud",
            removal_policy=cdk.RemovalPolicy.RETAIN,
        )  # fmt: skip
        acknowledge(self.signing_key, "rotated by two overlapping keys, see docs/operations.md", "SMG4")
        self._admit_balancer()
        names = ResourceNames(settings.cloud.name)
        for name, bucket in (
            ("maps", self.maps), ("artifacts", self.artifacts), ("audit-logs", self.audit_logs),
            ("access-logs", self.access_logs),
        ):  # fmt: skip
            provide(self, names, f"data/{name}", bucket.bucket_name)

    def _admit_balancer(self) -> None:
        """Allow load balancers of this account to write access logs.

        The statement belongs to the bucket's policy, which only this stack can change.
        """
        writer = region_info.RegionInfo.get(self.region).elbv2_account
        service = iam.ServicePrincipal("logdelivery.elasticloadbalancing.amazonaws.com")
        self.access_logs.add_to_resource_policy(
            iam.PolicyStatement(
                principals=[iam.AccountPrincipal(writer) if writer else service], actions=["s3:PutObject"],
                resources=[self.access_logs.arn_for_objects(f"{BALANCER_LOGS}/AWSLogs/{self.account}/*")],
            )
        )  # fmt: skip

    def _bucket(self, name: str, logs: s3.Bucket | None, locked_for: cdk.Duration | None = None) -> s3.Bucket:
        lock = None if locked_for is None else s3.ObjectLockRetention.governance(locked_for)
        return s3.Bucket(
            self, name, versioned=True, encryption=s3.BucketEncryption.S3_MANAGED, enforce_ssl=True,
            block_public_access=s3.BlockPublicAccess.BLOCK_ALL, removal_policy=cdk.RemovalPolicy.RETAIN,
            object_ownership=s3.ObjectOwnership.BUCKET_OWNER_ENFORCED,
            object_lock_enabled=None if lock is None else True, object_lock_default_retention=lock,
            server_access_logs_bucket=logs, server_access_logs_prefix=f"{name.lower()}/" if logs else None,
        )  # fmt: skip
