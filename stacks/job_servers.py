"""Job servers: a second Auto Scaling group, of Spot instances, that runs long jobs and batches.

They boot from the package of the backend servers, without robots, a load balancer or a data service.  The
group is empty until jobs wait; a job whose instance AWS takes back is given up at once and runs elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import aws_cdk as cdk
from aws_cdk import aws_autoscaling as autoscaling
from aws_cdk import aws_ec2 as ec2
from aws_cdk import aws_iam as iam
from aws_cdk import aws_sns as sns
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import zone_count
from rse_pf.config.resource_names import ResourceNames
from rse_pf.scaling.boot_time import BOOT_LIMIT_S
from rse_pf.scaling.health import DRAIN_S
from rse_pf.scaling.job_alarms import job_alarms_of
from stacks.backend_servers import launch_template
from stacks.findings import acknowledge
from stacks.scale_modifier import ScaleModifier

__all__ = ["JobServers"]


class JobServers(Construct):
    """Launch template, group, hooks and alarms; ``group`` is what the alarms act on."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        vpc: ec2.IVpc,
        firewall_group: ec2.ISecurityGroup,
        role: iam.Role,
        facts: Mapping[str, str],
        topic: sns.ITopic,
        settings: PlatformSettings,
    ) -> None:
        """Make the group.

        Args:
            scope: The backend stack.
            construct_id: Unique in it.
            vpc: Of the servers.
            firewall_group: Of job servers only: nobody but another job server reaches them.
            role: Of the backend servers, which make the same calls.
            facts: What a backend server is told at its boot; names of group and hooks are replaced.
            topic: Of alarms.
            settings: ``cloud.job_servers`` is above 0.
        """
        super().__init__(scope, construct_id)
        cloud, names = settings.cloud, ResourceNames(settings.cloud.name)
        job_facts = {
            **facts, "role": "jobs", "group": names.job_group, "hook": names.job_drain_hook,
            "launch": names.job_launch_hook,
        }  # fmt: skip
        kinds = [ec2.InstanceType(name) for name in cloud.job_instance_types.split()]
        template = launch_template(
            self, role=role, firewall_group=firewall_group, settings=settings, facts=job_facts, kind=kinds[0]
        )
        self.group = autoscaling.AutoScalingGroup(
            self, "Group", auto_scaling_group_name=names.job_group, vpc=vpc, min_capacity=0,
            max_capacity=cloud.job_servers,
            vpc_subnets=ec2.SubnetSelection(subnets=vpc.isolated_subnets[: zone_count(settings)]),
            mixed_instances_policy=autoscaling.MixedInstancesPolicy(
                launch_template=template,
                launch_template_overrides=[
                    autoscaling.LaunchTemplateOverrides(instance_type=kind) for kind in kinds
                ],
                instances_distribution=autoscaling.InstancesDistribution(
                    on_demand_base_capacity=0, on_demand_percentage_above_base_capacity=0,
                    spot_allocation_strategy=autoscaling.SpotAllocationStrategy.PRICE_CAPACITY_OPTIMIZED,
                ),
            ),
            default_instance_warmup=cdk.Duration.seconds(settings.scaling.warm_up_s),
            group_metrics=[autoscaling.GroupMetrics.all()],
            notifications=[autoscaling.NotificationConfiguration(topic=topic)],
        )  # fmt: skip
        resource = cast("autoscaling.CfnAutoScalingGroup", self.group.node.default_child)
        resource.capacity_rebalance = True
        acknowledge(self.group, "the rule cannot read references; the template encrypts its volume", "EC26")
        # In the group itself: a hook of its own would come after the first instances.
        hook = autoscaling.CfnAutoScalingGroup.LifecycleHookSpecificationProperty
        resource.lifecycle_hook_specification_list = [
            hook(
                lifecycle_hook_name=names.job_launch_hook, heartbeat_timeout=BOOT_LIMIT_S,
                lifecycle_transition="autoscaling:EC2_INSTANCE_LAUNCHING", default_result="ABANDON",
            ),
            hook(
                lifecycle_hook_name=names.job_drain_hook, heartbeat_timeout=DRAIN_S,
                lifecycle_transition="autoscaling:EC2_INSTANCE_TERMINATING", default_result="CONTINUE",
            ),
        ]  # fmt: skip
        ScaleModifier(
            self, "ScaleModifier", group_name=self.group.auto_scaling_group_name, topic_arn=topic.topic_arn,
            settings=settings, alarms=job_alarms_of(cloud),
        )  # fmt: skip
