"""The backend servers of Fig. 2: an Auto Scaling group of Debian machines without a route to the internet.

They boot from one package in S3, whose digest is in the template.  There is no SSH and no public address;
IMDSv2 is limited to one hop.  An instance that fails the load balancer's health checks is replaced, and an
instance that does not become ready in time never joins the group.

A deployment creates a new version of the launch template and replaces no server: the group keeps the version
that the stack's parameter `VERSION_PARAMETER` names.  Only ``rse-pf cloud upgrade`` changes the parameter,
after it has replaced the servers.
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
from rse_pf.config.cloud_layout import VOLUME_GB, zone_count
from rse_pf.config.resource_names import AUDIT_PREFIX, JOURNAL_PREFIX, VERSION_PARAMETER, ResourceNames
from rse_pf.scaling.alarms import NAMESPACE
from rse_pf.scaling.boot_time import BOOT_LIMIT_S, retry_within_s
from rse_pf.scaling.health import DRAIN_S, GRACE_S, MAX_HEALTHY_PERCENT
from stacks.capacity import Capacity
from stacks.permissions import allow

__all__ = ["BackendServers", "launch_template"]

_BOOT = Path(__file__).parent / "boot" / "first_boot.py"
_STORE = "rse_pf/aws/storage/s3_store.py:S3Store"


class BackendServers(Construct):
    """The servers' IAM role, launch template and Auto Scaling group.

    ``facts`` are the values, such as names of buckets, that an instance gets at its boot.
    """

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
        self.facts = {
            "package": package.s3_object_url, "sha256": package_sums, "region": settings.cloud.region,
            "domain": cdk.Aws.URL_SUFFIX, "bucket": artifacts.bucket_name, "keys": key_set,
            "group": names.group, "hook": names.drain_hook, "launch": names.launch_hook,
            "retry_s": f"{retry_within_s():g}",
            "store": f"s3:{maps.bucket_name}" if maps is not None else settings.data.store,
            "audit": audit_logs.bucket_name,
        }  # fmt: skip
        self.group = autoscaling.AutoScalingGroup(
            self, "Group", auto_scaling_group_name=names.group, vpc=vpc,
            min_capacity=scaling.min_servers, max_capacity=scaling.max_servers,
            vpc_subnets=ec2.SubnetSelection(subnets=vpc.isolated_subnets[: zone_count(settings)]),
            launch_template=launch_template(
                self, role=self.role, firewall_group=firewall_group, settings=settings, facts=self.facts
            ),
            health_checks=autoscaling.HealthChecks.with_additional_checks(
                additional_types=[autoscaling.AdditionalHealthCheckType.ELB],
                grace_period=cdk.Duration.seconds(GRACE_S),
            ),
            default_instance_warmup=cdk.Duration.seconds(scaling.warm_up_s),
            group_metrics=[autoscaling.GroupMetrics.all()],
            notifications=[autoscaling.NotificationConfiguration(topic=topic)],
        )  # fmt: skip
        Capacity(self, "Capacity", group=self.group, settings=settings)
        resource = cast("autoscaling.CfnAutoScalingGroup", self.group.node.default_child)
        resource.target_group_arns = [target.target_group_arn for target in targets]
        # A new server is ready before the unhealthy one is terminated, as in an upgrade.
        resource.instance_maintenance_policy = (
            autoscaling.CfnAutoScalingGroup.InstanceMaintenancePolicyProperty(
                min_healthy_percentage=100, max_healthy_percentage=MAX_HEALTHY_PERCENT
            )
        )
        # The hook is a property of the group: as a resource of its own it would be created after the first
        # instances were launched.
        resource.lifecycle_hook_specification_list = [
            autoscaling.CfnAutoScalingGroup.LifecycleHookSpecificationProperty(
                lifecycle_hook_name=names.launch_hook,
                lifecycle_transition="autoscaling:EC2_INSTANCE_LAUNCHING",
                heartbeat_timeout=BOOT_LIMIT_S, default_result="ABANDON",
            )
        ]  # fmt: skip
        self._keep_version(resource)
        self.group.add_lifecycle_hook(
            "Drain", lifecycle_hook_name=names.drain_hook,
            lifecycle_transition=autoscaling.LifecycleTransition.INSTANCE_TERMINATING,
            heartbeat_timeout=cdk.Duration.seconds(DRAIN_S),
            default_result=autoscaling.DefaultResult.CONTINUE,
        )  # fmt: skip

    def _keep_version(self, resource: autoscaling.CfnAutoScalingGroup) -> None:
        """Make the group use the launch template version in a stack parameter, which deployments keep."""
        version = cdk.CfnParameter(
            cdk.Stack.of(self), VERSION_PARAMETER, default="1", allowed_pattern="[1-9][0-9]*",
            description="launch template of the servers; rse-pf cloud upgrade changes it",
        )  # fmt: skip
        path = "LaunchTemplate"
        if resource.mixed_instances_policy is not None:
            path = "MixedInstancesPolicy.LaunchTemplate.LaunchTemplateSpecification"
        resource.add_property_override(f"{path}.Version", version.value_as_string)

    def _role(self, package: s3_assets.Asset, artifacts: s3.IBucket) -> iam.Role:
        role = iam.Role(self, "Role", assumed_by=iam.ServicePrincipal("ec2.amazonaws.com"))
        allow(
            role, ["s3:GetObject"], [package.bucket.arn_for_objects("*.zip")],
            used_by="stacks/boot/first_boot.py:asked",
            why="servers of the version before boot from the package before; a digest says what may run",
        )  # fmt: skip
        # Without ListBucket S3 answers "forbidden", not "not found", for a key set that does not exist yet.
        allow(role, ["s3:ListBucket"], [artifacts.bucket_arn], used_by=f"{_STORE}._get")
        allow(
            role, ["cloudwatch:PutMetricData"], ["*"],
            conditions={"StringEquals": {"cloudwatch:namespace": NAMESPACE}},
            used_by="rse_pf/aws/fleet/tasks/server_metrics.py:_Publisher.publish",
            why="PutMetricData takes no resources; the condition allows one namespace",
        )  # fmt: skip
        allow(
            role, ["cloudwatch:GetMetricData"], ["*"],
            used_by="rse_pf/aws/fleet/tasks/rebalancing.py:read_totals",
            why="GetMetricData takes neither resources nor conditions; it reads numbers only",
        )  # fmt: skip
        allow(
            role, ["s3:PutObject"], [artifacts.arn_for_objects(f"{JOURNAL_PREFIX}/*")],
            used_by=f"{_STORE}._write", why="names hold the instance's id and a time",
        )  # fmt: skip
        return role

    def _allow_objects(self, maps: s3.IBucket) -> None:
        """Allow servers and data services to read and write robots' objects and maps."""
        allow(
            self.role, ["s3:GetObject", "s3:PutObject", "s3:DeleteObject", "s3:AbortMultipartUpload"],
            [maps.arn_for_objects("*")],
            used_by=(f"{_STORE}._get", f"{_STORE}._write", f"{_STORE}.delete", f"{_STORE}.put_pieces"),
            why="names of objects are digests, which are not known beforehand",
        )  # fmt: skip
        allow(self.role, ["s3:ListBucket"], [maps.bucket_arn], used_by=f"{_STORE}._pages")

    def _allow_audit(self, audit_logs: s3.IBucket) -> None:
        """Allow the servers to write audit logs under new names, but not to read, list or delete them."""
        allow(
            self.role, ["s3:PutObject"], [audit_logs.arn_for_objects(f"{AUDIT_PREFIX}/*")],
            conditions={"Null": {"s3:if-none-match": "false"}}, used_by=f"{_STORE}._write",
            why="names hold the instance's id and a digest; no name twice",
        )  # fmt: skip


def launch_template(
    scope: Construct,
    *,
    role: iam.Role,
    firewall_group: ec2.ISecurityGroup,
    settings: PlatformSettings,
    facts: Mapping[str, str],
) -> ec2.LaunchTemplate:
    """Return the launch template of a server, whose user data run `stacks/boot/first_boot.py`.

    Args:
        scope: Construct that contains the template.
        role: IAM role of the instance.
        firewall_group: The only security group of the instance.
        settings: Settings of the platform, with image and instance type.
        facts: Values that `first_boot.main` gets, by name; plain words without quotes.
    """
    encrypted = ec2.BlockDeviceVolume.ebs(
        VOLUME_GB, encrypted=True, volume_type=ec2.EbsDeviceVolumeType.GP3, delete_on_termination=True
    )
    script = _BOOT.read_text(encoding="utf-8")
    commands = f"{script}\nmain({cdk.Stack.of(scope).to_json_string(dict(facts))!s})\n"
    return ec2.LaunchTemplate(
        scope, "Template", instance_type=ec2.InstanceType(settings.cloud.instance_type), role=role,
        machine_image=ec2.MachineImage.from_ssm_parameter(
            settings.cloud.image_parameter, os=ec2.OperatingSystemType.LINUX
        ),
        security_group=firewall_group, require_imdsv2=True, http_put_response_hop_limit=1,
        http_endpoint=True, detailed_monitoring=True, associate_public_ip_address=False,
        user_data=ec2.UserData.custom(commands),
        block_devices=[ec2.BlockDevice(device_name="/dev/xvda", volume=encrypted)],
    )  # fmt: skip
