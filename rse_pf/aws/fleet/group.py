"""Read the state of the Auto Scaling group: its servers, their target health, alarms, and robots.

Nothing is changed.  A number of robots that no agent published is None, never zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime, timedelta

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.metrics import ROBOTS, dimensions_of
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError
from rse_pf.scaling.alarms import NAMESPACE

__all__ = ["AutoScalingGroup", "Server", "read_group"]

# Number of periods after which a published number of robots counts as unknown.
_FRESH_PERIODS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Server:
    """One instance of the group.

    Attributes:
        name: Instance id.
        zone: Availability zone.
        state: Lifecycle state in the group, such as ``InService``.
        targets: Its health in each target group of the load balancer; ``absent`` where it is no target.
        robots: Number of connected robots; None if it is unknown.
    """

    name: str
    zone: str
    state: str
    targets: tuple[str, ...]
    robots: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoScalingGroup:
    """The state of the group, as ``rse-pf cloud status`` shows it.

    *alarms* maps the name of each alarm to its state, *reasons* to CloudWatch's reason for that state.
    """

    min_servers: int
    wanted_servers: int
    max_servers: int
    servers: tuple[Server, ...]
    alarms: dict[str, str]
    reasons: dict[str, str] = field(default_factory=dict)
    target_groups: tuple[str, ...] = ()

    @property
    def robots(self) -> tuple[float, ...]:
        """The numbers of robots of those servers whose number is known."""
        return tuple(server.robots for server in self.servers if server.robots is not None)

    @property
    def is_healthy(self) -> bool:
        """Whether at least as many servers as wanted are in service and healthy in every target group."""
        healthy = [s for s in self.servers if s.state == "InService" and set(s.targets) == {"healthy"}]
        return len(healthy) >= self.wanted_servers


def read_group(
    account: Account, settings: PlatformSettings, *, now: datetime, asks_robots: bool = True
) -> AutoScalingGroup:
    """Return the state of the group.

    Args:
        account: AWS account and region of the group.
        settings: Settings of the platform.
        now: The time in UTC.
        asks_robots: Whether the numbers of robots are read from CloudWatch, which costs a fee; else they are
            None.

    Raises:
        ConfigurationError: There is no group in the region, or AWS refused.
        StoreError: AWS does not answer.
    """
    of = ResourceNames(settings.cloud.name)
    groups = account.pages(
        "autoscaling", "describe_auto_scaling_groups", "AutoScalingGroups", AutoScalingGroupNames=[of.group]
    )
    if not groups:
        raise ConfigurationError(f"no platform runs in {account.region}", hint="put it up: rse-pf cloud up")
    group = groups[0]
    health = [_read_target_health(account, arn) for arn in group["TargetGroupARNs"]]
    names = [instance["InstanceId"] for instance in group["Instances"]]
    robots = _read_robots(account, of.group, names, settings.scaling.period_s, now) if asks_robots else {}
    alarms = account.pages("cloudwatch", "describe_alarms", "MetricAlarms", AlarmNamePrefix=of.alarm_prefix)
    return AutoScalingGroup(
        min_servers=group["MinSize"],
        wanted_servers=group["DesiredCapacity"],
        max_servers=group["MaxSize"],
        servers=tuple(
            Server(
                name=instance["InstanceId"],
                zone=instance["AvailabilityZone"],
                state=instance["LifecycleState"],
                targets=tuple(states.get(instance["InstanceId"], "absent") for states in health),
                robots=robots.get(instance["InstanceId"]),
            )
            for instance in sorted(group["Instances"], key=lambda row: str(row["InstanceId"]))
        ),
        alarms={alarm["AlarmName"].removeprefix(of.alarm_prefix): alarm["StateValue"] for alarm in alarms},
        reasons={
            alarm["AlarmName"].removeprefix(of.alarm_prefix): str(alarm.get("StateReason", ""))
            for alarm in alarms
        },
        target_groups=tuple(group["TargetGroupARNs"]),
    )


def _read_target_health(account: Account, arn: str) -> dict[str, str]:
    """Return the health of each instance in the target group *arn*, such as ``healthy``, by instance id."""
    rows = account.pages("elbv2", "describe_target_health", "TargetHealthDescriptions", TargetGroupArn=arn)
    return {row["Target"]["Id"]: row["TargetHealth"]["State"] for row in rows}


def _read_robots(
    account: Account, group: str, servers: list[str], period_s: int, now: datetime
) -> dict[str, float]:
    """Return the newest number of robots of each server in the last `_FRESH_PERIODS` complete periods.

    Servers without a value are left out.  The current period is not read, because some agents may not have
    published their number yet.
    """
    end = datetime.fromtimestamp(now.timestamp() // period_s * period_s, now.tzinfo)
    queries = [
        {
            "Id": f"q{at}",
            "MetricStat": {
                "Metric": {
                    "Namespace": NAMESPACE, "MetricName": ROBOTS, "Dimensions": dimensions_of(group, server),
                },
                "Period": period_s,
                "Stat": "Maximum",
            },
        }
        for at, server in enumerate(servers)
    ]  # fmt: skip
    if not queries:
        return {}
    results = account.pages(
        "cloudwatch", "get_metric_data", "MetricDataResults",
        MetricDataQueries=queries, ScanBy="TimestampDescending",
        StartTime=end - timedelta(seconds=_FRESH_PERIODS * period_s), EndTime=end,
    )  # fmt: skip
    newest: dict[str, float] = {}
    for row in results:
        if row["Values"]:
            newest.setdefault(servers[int(row["Id"].removeprefix("q"))], row["Values"][0])
    return newest
