"""The capacity of the backend servers: a warm pool, Spot, several instance types, zones and a schedule.

Everything here configures the Auto Scaling group of `stacks.backend_servers`, and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from aws_cdk import aws_autoscaling as autoscaling
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import ON_DEMAND_SERVERS
from rse_pf.config.elasticity import instance_types
from rse_pf.config.schedule import ScheduleEntry, parse_schedule
from stacks.findings import acknowledge

__all__ = ["Capacity"]

# Percentage of on-demand instances if Spot instances are not used.
_ALL_ON_DEMAND = 100


class Capacity(Construct):
    """The warm pool, purchase options, zones and scheduled minimum size of one Auto Scaling group."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        group: autoscaling.AutoScalingGroup,
        settings: PlatformSettings,
    ) -> None:
        super().__init__(scope, construct_id)
        raw = cast("autoscaling.CfnAutoScalingGroup", group.node.default_child)
        # Each zone gets the same number of servers; if a zone has no capacity, the others get its servers.
        raw.availability_zone_distribution = (
            autoscaling.CfnAutoScalingGroup.AvailabilityZoneDistributionProperty(
                capacity_distribution_strategy="balanced-best-effort"
            )
        )
        types = instance_types(settings.cloud.instance_type, settings.cloud.other_instance_types)
        if settings.cloud.spot or len(types) > 1:
            self._allow_mixed_instances(raw, types, settings)
        if settings.cloud.warm_servers:
            # "Only when MaxGroupPreparedCapacity and MinSize are set to the same value does the warm pool
            # have an absolute size" (AWS, PutWarmPool); else the pool fills the group up to its maximum.
            autoscaling.CfnWarmPool(
                self, "WarmPool", auto_scaling_group_name=group.auto_scaling_group_name, pool_state="Stopped",
                min_size=settings.cloud.warm_servers,
                max_group_prepared_capacity=settings.cloud.warm_servers,
                instance_reuse_policy=autoscaling.CfnWarmPool.InstanceReusePolicyProperty(
                    reuse_on_scale_in=False
                ),
            )  # fmt: skip
        for number, entry in enumerate(parse_schedule(settings.scaling.schedule)):
            autoscaling.CfnScheduledAction(
                self, f"Schedule{number}", auto_scaling_group_name=group.auto_scaling_group_name,
                min_size=entry.min_servers, recurrence=_cron(entry), time_zone=_time_zone(settings),
            )  # fmt: skip

    def _allow_mixed_instances(
        self, raw: autoscaling.CfnAutoScalingGroup, types: Sequence[str], settings: PlatformSettings
    ) -> None:
        """Let the group use several instance *types* and, with ``cloud.spot``, Spot instances.

        `ON_DEMAND_SERVERS` servers are on demand nevertheless.
        """
        cloud, kind = settings.cloud, autoscaling.CfnAutoScalingGroup
        raw.mixed_instances_policy = kind.MixedInstancesPolicyProperty(
            launch_template=kind.LaunchTemplateProperty(
                launch_template_specification=cast(
                    "autoscaling.CfnAutoScalingGroup.LaunchTemplateSpecificationProperty", raw.launch_template
                ),
                overrides=[kind.LaunchTemplateOverridesProperty(instance_type=name) for name in types],
            ),
            instances_distribution=kind.InstancesDistributionProperty(
                on_demand_allocation_strategy="prioritized",
                on_demand_base_capacity=ON_DEMAND_SERVERS,
                on_demand_percentage_above_base_capacity=0 if cloud.spot else _ALL_ON_DEMAND,
                spot_allocation_strategy="price-capacity-optimized",
            ),
        )
        raw.launch_template = None
        raw.capacity_rebalance = cloud.spot
        acknowledge(raw, "the rule cannot read this form; the launch template encrypts the volume", "EC26")


def _cron(entry: ScheduleEntry) -> str:
    return f"{entry.minute} {entry.hour} * * {','.join(map(str, entry.days))}"


def _time_zone(settings: PlatformSettings) -> str:
    # Auto Scaling knows UTC only by the name Etc/UTC.
    return "Etc/UTC" if settings.scaling.time_zone == "UTC" else settings.scaling.time_zone
