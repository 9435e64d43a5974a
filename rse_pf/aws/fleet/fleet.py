"""Look at a fleet that runs: its servers, what the load balancer thinks of them, alarms, and robots.

Promises to change nothing, and to say when nobody told a number instead of calling it zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.metrics import ROBOTS, dimensions_of
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import GROUP
from rse_pf.errors import ConfigurationError
from rse_pf.scaling.alarms import NAMESPACE

__all__ = ["GROUP", "AutoScalingGroup", "Server", "look_at"]

_ALARMS = "rse-pf-"
_PERIODS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Server:
    """One instance; ``targets`` is its health in each target group, ``robots`` is None if it did not tell."""

    name: str
    zone: str
    state: str
    targets: tuple[str, ...]
    robots: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoScalingGroup:
    """Everything `rse-pf cloud status` shows."""

    least: int
    wanted: int
    most: int
    servers: tuple[Server, ...]
    alarms: dict[str, str]

    @property
    def robots(self) -> tuple[float, ...]:
        """How many robots each server has that told it."""
        return tuple(each.robots for each in self.servers if each.robots is not None)

    @property
    def is_well(self) -> bool:
        """Whether every wanted server is there, and healthy wherever it is asked."""
        good = [
            each
            for each in self.servers
            if each.targets and each.state == "InService" and set(each.targets) == {"healthy"}
        ]
        return len(good) >= self.wanted


def look_at(account: Account, settings: PlatformSettings, *, now: datetime) -> AutoScalingGroup:
    """Return how the fleet is at *now*, in UTC.

    Raises:
        ConfigurationError: There is no fleet in the region, or AWS refused.
        StoreError: AWS does not answer.
    """
    found = account.pages(
        "autoscaling", "describe_auto_scaling_groups", "AutoScalingGroups", AutoScalingGroupNames=[GROUP]
    )
    if not found:
        raise ConfigurationError(
            f"no platform runs in {account.region}", hint="deploy it: npx cdk deploy --all"
        )
    group = found[0]
    health = _health(account, group["TargetGroupARNs"])
    names = [each["InstanceId"] for each in group["Instances"]]
    told = _robots(account, names, settings.scaling.period_s, now)
    alarms = account.pages("cloudwatch", "describe_alarms", "MetricAlarms", AlarmNamePrefix=_ALARMS)
    return AutoScalingGroup(
        least=group["MinSize"],
        wanted=group["DesiredCapacity"],
        most=group["MaxSize"],
        servers=tuple(
            Server(
                name=each["InstanceId"],
                zone=each["AvailabilityZone"],
                state=each["LifecycleState"],
                targets=tuple(one.get(each["InstanceId"], "absent") for one in health),
                robots=told.get(each["InstanceId"]),
            )
            for each in sorted(group["Instances"], key=lambda one: str(one["InstanceId"]))
        ),
        alarms={each["AlarmName"].removeprefix(_ALARMS): each["StateValue"] for each in alarms},
    )


def _health(account: Account, target_groups: list[str]) -> list[dict[str, str]]:
    """Return, for each target group, what it says of each instance."""
    made = []
    for arn in target_groups:
        found = account.find("elbv2", "describe_target_health", TargetGroupArn=arn) or {}
        rows = found.get("TargetHealthDescriptions", ())
        made.append({row["Target"]["Id"]: row["TargetHealth"]["State"] for row in rows})
    return made


def _robots(account: Account, servers: list[str], period_s: int, now: datetime) -> dict[str, float]:
    """Return the newest value of each server in the last periods that are over; absent is absent.

    The period that runs is left out: half of the servers may not have told theirs yet.
    """
    end = datetime.fromtimestamp(now.timestamp() // period_s * period_s, now.tzinfo)
    queries = [
        {
            "Id": f"q{at}",
            "MetricStat": {
                "Metric": {
                    "Namespace": NAMESPACE, "MetricName": ROBOTS, "Dimensions": dimensions_of(GROUP, server),
                },
                "Period": period_s,
                "Stat": "Maximum",
            },
        }
        for at, server in enumerate(servers)
    ]  # fmt: skip
    if not queries:
        return {}
    found = account.pages(
        "cloudwatch", "get_metric_data", "MetricDataResults",
        MetricDataQueries=queries, ScanBy="TimestampDescending",
        StartTime=end - timedelta(seconds=_PERIODS * period_s), EndTime=end,
    )  # fmt: skip
    newest: dict[str, float] = {}
    for row in found:
        if row["Values"]:
            newest.setdefault(servers[int(row["Id"].removeprefix("q"))], row["Values"][0])
    return newest
