"""The backend stack: load balancer, backend servers, monitor, scale modifier and the topic of alarms."""

from __future__ import annotations

import tempfile
from pathlib import Path

import aws_cdk as cdk
from aws_cdk import aws_iam as iam
from aws_cdk import aws_s3_assets as s3_assets
from aws_cdk import aws_sns as sns
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import zone_count
from rse_pf.config.resource_names import (
    DENY_NAME,
    KEYS_NAME,
    ROBOTS_NAME,
    ROBOTS_PATH,
    SERVICES_PREFIX,
    ResourceNames,
)
from stacks.assets import SERVERS, staged, sums_digest
from stacks.backend_servers import BackendServers
from stacks.load_balancer import LoadBalancer
from stacks.network_stack import CIDR, ZONES
from stacks.permissions import allow
from stacks.scale_modifier import ScaleModifier
from stacks.values import import_bucket, import_group, import_network, provide

__all__ = ["TRUSTED", "BackendStack"]

TRUSTED = (KEYS_NAME, ROBOTS_NAME, DENY_NAME)
"""Names of the objects that decide which robots may connect: public keys, roster and deny list."""


class BackendStack(cdk.Stack):
    """The stack with everything that a new release changes.

    It reads network and buckets from other stacks, and provides for them the ARNs ``backend/topic``,
    ``backend/balancer``, ``backend/listener`` and ``backend/robots`` (the robots' target group), and the
    robots' address ``backend/url``.
    """

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: PlatformSettings,
        assets: Path,
        env: cdk.Environment,
        synthesizer: cdk.IStackSynthesizer | None = None,
    ) -> None:
        super().__init__(scope, construct_id, env=env, synthesizer=synthesizer)
        names = ResourceNames(settings.cloud.name)
        vpc = import_network(self, names, zones=ZONES, server_zones=zone_count(settings), cidr=CIDR)
        artifacts = import_bucket(self, names, "artifacts")
        self.topic = sns.Topic(self, "Events", enforce_ssl=True)
        # A policy for TLS (enforce_ssl) replaces the default policy of the topic, which lets the account's
        # alarms publish; therefore they are allowed here.
        self.topic.add_to_resource_policy(
            iam.PolicyStatement(
                principals=[
                    iam.ServicePrincipal(f"{each}.amazonaws.com") for each in ("cloudwatch", "budgets")
                ],
                actions=["sns:Publish"],
                resources=[self.topic.topic_arn],
                conditions={"StringEquals": {"aws:SourceAccount": self.account}},
            )
        )  # fmt: skip
        self.balancer = LoadBalancer(
            self, "LoadBalancer", vpc=vpc, group=import_group(self, names, "balancer"), settings=settings,
            logs=import_bucket(self, names, "access-logs"),
        )  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            path = staged(assets, SERVERS, settings, Path(folder))
            package, sums = s3_assets.Asset(self, "Package", path=str(path)), sums_digest(path)
        self.servers = BackendServers(
            self, "Servers", vpc=vpc, firewall_group=import_group(self, names, "servers"), package=package,
            package_sums=sums, topic=self.topic, targets=list(self.balancer.targets.values()),
            settings=settings, artifacts=artifacts,
            maps=import_bucket(self, names, "maps") if settings.data.enabled else None,
            audit_logs=import_bucket(self, names, "audit-logs"), key_set=KEYS_NAME,
        )  # fmt: skip
        allow(
            self.servers.role, ["s3:GetObject"], [artifacts.arn_for_objects(name) for name in TRUSTED],
            used_by="rse_pf/aws/storage/s3_store.py:S3Store._get",
        )  # fmt: skip
        allow(
            self.servers.role, ["s3:GetObject"], [artifacts.arn_for_objects(f"{SERVICES_PREFIX}/*")],
            used_by="rse_pf/aws/storage/s3_store.py:S3Store._get",
            why="archives of published services are named by their digests; operators alone write them",
        )  # fmt: skip
        group = self.servers.group
        # The group is named, not referenced: a reference would be a cycle, because the group needs the role.
        allow(
            self.servers.role, ["autoscaling:CompleteLifecycleAction"],
            [
                self.format_arn(
                    service="autoscaling", resource="autoScalingGroup",
                    resource_name=f"*:autoScalingGroupName/{names.group}",
                    arn_format=cdk.ArnFormat.COLON_RESOURCE_NAME,
                )
            ],
            used_by=("rse_pf/aws/fleet/launch_hook.py:complete_hook", "stacks/boot/first_boot.py:abandon"),
            why="the ARN of an Auto Scaling group holds an id that AWS assigns",
        )  # fmt: skip
        ScaleModifier(
            self, "ScaleModifier", group_name=group.auto_scaling_group_name, topic_arn=self.topic.topic_arn,
            settings=settings,
        )  # fmt: skip
        provide(self, names, "backend/topic", self.topic.topic_arn)
        provide(self, names, "backend/balancer", self.balancer.alb.load_balancer_arn)
        provide(self, names, "backend/listener", self.balancer.listener.listener_arn)
        provide(self, names, "backend/robots", self.balancer.targets["robots"].target_group_arn)
        self._outputs(settings)

    def _outputs(self, settings: PlatformSettings) -> None:
        cdk.CfnOutput(self, "Topic", value=self.topic.topic_arn, description="subscribe to receive alarms")
        name, domain = self.balancer.alb.load_balancer_dns_name, settings.cloud.domain_name
        path, insecure = ROBOTS_PATH, settings.cloud.allow_insecure
        url = f"ws://{name}{path}" if insecure else f"wss://{domain}{path}"
        cdk.CfnOutput(self, "Url", value=url)
        provide(self, ResourceNames(settings.cloud.name), "backend/url", url)
        if insecure:
            cdk.Annotations.of(self).add_warning_v2(
                "rse-pf:allow-insecure",
                "cloud.allow_insecure is true: robots and tokens travel without TLS; for trials only",
            )
        else:
            cdk.CfnOutput(self, "Cname", value=f"{domain} CNAME {name}")
