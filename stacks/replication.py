"""Replicate keys, roster, deny list, services and maps to the buckets of deployments in other regions.

One deployment is the primary one: operators enrol robots, rotate keys and publish services there.  S3 copies
public keys, roster, deny list, published services and versions of maps from it to the others, in this
direction only.  Live maps, jobs and robots' objects are not copied: a lease is valid in one region only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import aws_cdk as cdk
from aws_cdk import aws_iam as iam
from aws_cdk import aws_s3 as s3
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import KEYS_NAME, SERVICES_PREFIX
from stacks.permissions import BY_AWS, allow

__all__ = ["ARTIFACT_PREFIXES", "MAP_PREFIXES", "Replication"]

ARTIFACT_PREFIXES = (KEYS_NAME, "control/", f"{SERVICES_PREFIX}/")
"""Prefixes of the objects that are copied from the artifact bucket.

`rse_pf.auth.trust_store` writes roster and deny list below ``control/``."""
MAP_PREFIXES = ("maps/",)
"""Prefixes of the objects that are copied from the map bucket: versions and heads of maps, not live maps."""
_BY_S3 = f"{BY_AWS}S3 copies the objects of a replication rule in this role"


class Replication(Construct):
    """The replication rules of the artifact and the map bucket, and the IAM role with which S3 copies."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        artifacts: s3.Bucket,
        maps: s3.Bucket,
        settings: PlatformSettings,
    ) -> None:
        super().__init__(scope, construct_id)
        self._role = iam.Role(self, "Role", assumed_by=iam.ServicePrincipal("s3.amazonaws.com"))
        self._copy(artifacts, settings.cloud.replica_artifacts.split(), ARTIFACT_PREFIXES)
        self._copy(maps, settings.cloud.replica_maps.split(), MAP_PREFIXES)

    def _copy(self, bucket: s3.Bucket, replicas: Sequence[str], prefixes: Sequence[str]) -> None:
        """Add rules that copy new objects below *prefixes*, and deletions, to the buckets *replicas*."""
        if not replicas:
            return
        targets = [f"arn:{cdk.Aws.PARTITION}:s3:::{replica}" for replica in replicas]
        allow(
            self._role, ["s3:GetReplicationConfiguration", "s3:ListBucket"], [bucket.bucket_arn],
            used_by=_BY_S3,
        )  # fmt: skip
        allow(
            self._role,
            ["s3:GetObjectVersionForReplication", "s3:GetObjectVersionAcl", "s3:GetObjectVersionTagging"],
            [bucket.arn_for_objects(f"{prefix}*") for prefix in prefixes],
            used_by=_BY_S3, why="the rule copies whatever lies below these prefixes",
        )  # fmt: skip
        allow(
            self._role, ["s3:ReplicateObject", "s3:ReplicateDelete", "s3:ReplicateTags"],
            [f"{target}/{prefix}*" for target in targets for prefix in prefixes],
            used_by=_BY_S3, why="the rule copies whatever lies below these prefixes",
        )  # fmt: skip
        rules = [
            s3.CfnBucket.ReplicationRuleProperty(
                id=f"to-{at}-{prefix.rstrip('/').replace('.', '-')}", priority=number, status="Enabled",
                filter=s3.CfnBucket.ReplicationRuleFilterProperty(prefix=prefix),
                delete_marker_replication=s3.CfnBucket.DeleteMarkerReplicationProperty(status="Enabled"),
                destination=s3.CfnBucket.ReplicationDestinationProperty(bucket=target),
            )
            for number, (at, target, prefix) in enumerate(
                ((at, target, prefix) for at, target in enumerate(targets) for prefix in prefixes), 1
            )
        ]  # fmt: skip
        cast(
            "s3.CfnBucket", bucket.node.default_child
        ).replication_configuration = s3.CfnBucket.ReplicationConfigurationProperty(
            role=self._role.role_arn, rules=rules
        )
