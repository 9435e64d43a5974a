"""The sources of the servers' capacity: a warm pool, Spot, several instance types, zones and a schedule.

Everything here changes the Auto Scaling group that `stacks.backend_servers` made, and nothing else.
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

# Percentage of on-demand servers where Spot instances are not used.
_ALL_ON_DEMAND = 100


class Capacity(Construct):
    """Warm pool, purchase options, zones and scheduled minimum of one group."""

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
        # Zones hold equal numbers while all have capacity; a zone without capacity is left out.
        raw.availability_zone_distribution = (
            autoscaling.CfnAutoScalingGroup.AvailabilityZoneDistributionProperty(
                capacity_distribution_strategy="balanced-best-effort"
            )
        )
        types = instance_types(settings.cloud.instance_type, settings.cloud.other_instance_types)
        if settings.cloud.spot or len(types) > 1:
            self._mix(raw, types, settings)
        if settings.cloud.warm_servers:
            # "Only when MaxGroupPreparedCapacity and MinSize are set to the same value does the warm pool
            # have an absolute size" (AWS, PutWarmPool); else it grows to what is missing to the maximum.
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
                min_size=entry.min_servers, recurrence=_cron(entry), time_zone=_zone(settings),
            )  # fmt: skip

    def _mix(
        self, raw: autoscaling.CfnAutoScalingGroup, types: Sequence[str], settings: PlatformSettings
    ) -> None:
        """Let the group take several instance types, and Spot instances above the servers on demand."""
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


def _zone(settings: PlatformSettings) -> str:
    # Auto Scaling takes Universal Time under this name only.
    return "Etc/UTC" if settings.scaling.time_zone == "UTC" else settings.scaling.time_zone
