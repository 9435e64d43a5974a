"""The backend servers of Fig. 2: an Auto Scaling group of Debian machines without a route to the internet.

They boot from one package in S3, whose digest is in the template.  There is no SSH and no public address;
IMDSv2 is limited to one hop.  An instance that the load balancer finds unhealthy is replaced.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import aws_cdk as cdk
from aws_cdk import aws_autoscaling as autoscaling
from aws_cdk import aws_ec2 as ec2
from aws_cdk import aws_elasticloadbalancingv2 as elbv2
from aws_cdk import aws_iam as iam
from aws_cdk import aws_s3 as s3
from aws_cdk import aws_s3_assets as s3_assets
from aws_cdk import aws_sns as sns
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import AUDIT_PREFIX, ResourceNames
from rse_pf.scaling.alarms import NAMESPACE
from stacks.findings import acknowledge

__all__ = ["BackendServers"]

_BOOT = Path(__file__).parent / "boot" / "first_boot.py"
_MAPS_FINDING = "IAM5[Resource::arn:aws:s3:::<DataMaps>/*]"
_AUDIT_FINDING = f"IAM5[Resource::arn:aws:s3:::<DataAuditLogs>/{AUDIT_PREFIX}/*]"
_GIB = 8
_START_S = 300


class BackendServers(Construct):
    """Role, launch template and group; ``group`` is what the scale modifier acts on."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        vpc: ec2.IVpc,
        firewall_group: ec2.ISecurityGroup,
        package: s3_assets.Asset,
        package_sums: str,
        topic: sns.ITopic,
        targets: Sequence[elbv2.IApplicationTargetGroup],
        artifacts: s3.IBucket,
        maps: s3.IBucket | None,
        audit_logs: s3.IBucket,
        key_set: str,
        settings: PlatformSettings,
    ) -> None:
        super().__init__(scope, construct_id)
        scaling, names = settings.scaling, ResourceNames(settings.cloud.name)
        self.role = self._role(package, artifacts)
        if maps is not None:
            self._allow_objects(maps)
        self._allow_audit(audit_logs)
        self.group = autoscaling.AutoScalingGroup(
            self, "Group", auto_scaling_group_name=names.group, vpc=vpc,
            min_capacity=scaling.min_servers, max_capacity=scaling.max_servers,
            vpc_subnets=ec2.SubnetSelection(subnet_type=ec2.SubnetType.PRIVATE_ISOLATED),
            launch_template=self._template(
                firewall_group, settings,
                {
                    "package": package.s3_object_url, "sha256": package_sums, "region": settings.cloud.region,
                    "bucket": artifacts.bucket_name, "keys": key_set, "group": names.group,
                    "hook": names.drain_hook,
                    "store": f"s3:{maps.bucket_name}" if maps is not None else settings.data.store,
                    "audit": audit_logs.bucket_name,
                },
            ),
            health_checks=autoscaling.HealthChecks.with_additional_checks(
                additional_types=[autoscaling.AdditionalHealthCheckType.ELB],
                grace_period=cdk.Duration.seconds(settings.health.grace_s),
            ),
            default_instance_warmup=cdk.Duration.seconds(scaling.warm_up_s),
            group_metrics=[autoscaling.GroupMetrics.all()],
            notifications=[autoscaling.NotificationConfiguration(topic=topic)],
            update_policy=autoscaling.UpdatePolicy.rolling_update(
                max_batch_size=1, min_instances_in_service=scaling.min_servers,
                pause_time=cdk.Duration.seconds(settings.health.grace_s + _START_S),
            ),
        )  # fmt: skip
        cast("autoscaling.CfnAutoScalingGroup", self.group.node.default_child).target_group_arns = [
            each.target_group_arn for each in targets
        ]
        self.group.add_lifecycle_hook(
            "Drain", lifecycle_hook_name=names.drain_hook,
            lifecycle_transition=autoscaling.LifecycleTransition.INSTANCE_TERMINATING,
            heartbeat_timeout=cdk.Duration.seconds(settings.cloud.drain_s),
            default_result=autoscaling.DefaultResult.CONTINUE,
        )  # fmt: skip

    def _role(self, package: s3_assets.Asset, artifacts: s3.IBucket) -> iam.Role:
        role = iam.Role(self, "Role", assumed_by=iam.ServicePrincipal("ec2.amazonaws.com"))
        role.add_to_policy(
            iam.PolicyStatement(
                actions=["s3:GetObject"], resources=[package.bucket.arn_for_objects(package.s3_object_key)]
            )
        )
        # Without it S3 answers "forbidden" for a key set that is not there yet, instead of "not found".
        role.add_to_policy(iam.PolicyStatement(actions=["s3:ListBucket"], resources=[artifacts.bucket_arn]))
        role.add_to_policy(
            iam.PolicyStatement(
                actions=["cloudwatch:PutMetricData"], resources=["*"],
                conditions={"StringEquals": {"cloudwatch:namespace": NAMESPACE}},
            )
        )  # fmt: skip
        acknowledge(
            role, "PutMetricData knows no resources; the condition allows one namespace", "IAM5[Resource::*]"
        )
        return role

    def _allow_objects(self, maps: s3.IBucket) -> None:
        """Allow the servers and the data service beside them to read and write robots' objects and maps."""
        objects = maps.arn_for_objects("*")
        actions = ["s3:GetObject", "s3:PutObject", "s3:DeleteObject"]
        self.role.add_to_policy(iam.PolicyStatement(actions=actions, resources=[objects]))
        self.role.add_to_policy(iam.PolicyStatement(actions=["s3:ListBucket"], resources=[maps.bucket_arn]))
        acknowledge(self.role, "names of objects are digests, which nobody knows beforehand", _MAPS_FINDING)

    def _allow_audit(self, audit_logs: s3.IBucket) -> None:
        """Allow the servers to write pieces of the audit log under new names; not to read, list or delete."""
        self.role.add_to_policy(
            iam.PolicyStatement(
                actions=["s3:PutObject"], resources=[audit_logs.arn_for_objects(f"{AUDIT_PREFIX}/*")],
                conditions={"Null": {"s3:if-none-match": "false"}},
            )
        )  # fmt: skip
        acknowledge(self.role, "names hold the instance's id and a digest; no name twice", _AUDIT_FINDING)

    def _template(
        self,
        firewall_group: ec2.ISecurityGroup,
        settings: PlatformSettings,
        facts: Mapping[str, str],
    ) -> ec2.LaunchTemplate:
        encrypted = ec2.BlockDeviceVolume.ebs(
            _GIB, encrypted=True, volume_type=ec2.EbsDeviceVolumeType.GP3, delete_on_termination=True
        )
        script = _BOOT.read_text(encoding="utf-8")
        commands = f"{script}\nmain({cdk.Stack.of(self).to_json_string(dict(facts))!s})\n"
        return ec2.LaunchTemplate(
            self, "Template", instance_type=ec2.InstanceType(settings.cloud.instance_type), role=self.role,
            machine_image=ec2.MachineImage.from_ssm_parameter(
                settings.cloud.image_parameter, os=ec2.OperatingSystemType.LINUX
            ),
            security_group=firewall_group, require_imdsv2=True, http_put_response_hop_limit=1,
            http_endpoint=True, detailed_monitoring=True, associate_public_ip_address=False,
            user_data=ec2.UserData.custom(commands),
            block_devices=[ec2.BlockDevice(device_name="/dev/xvda", volume=encrypted)],
        )  # fmt: skip
