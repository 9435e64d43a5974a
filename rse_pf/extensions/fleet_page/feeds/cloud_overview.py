"""Read the state of a deployment on AWS: the group, its load balancer, and its last scaling activities.

The calls change nothing, and AWS does not charge for them.  Reading the group must succeed; an error of
another part becomes a sentence in `CloudOverview.problems`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from typing import TypeVar

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.group import AutoScalingGroup, read_group
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import RsePfError

__all__ = ["CloudBalancer", "CloudOverview", "ScalingActivity", "read_overview"]

# Number of the newest scaling activities that are read: one page of the answer, the last hours of a busy
# group.
_MAX_ACTIVITIES = 50
# AWS accepts at most this many values in one filter.
_MAX_FILTER_VALUES = 200
# Final states of a scaling activity that was not carried out.
_FAILED = ("Failed", "Cancelled")

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudBalancer:
    """The load balancer: its state as AWS names it, its DNS name, and the protocols of its listeners."""

    state: str
    address: str
    protocols: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScalingActivity:
    """One launch or termination of a server, completed or not; ``began_s`` is in Unix seconds."""

    id: str
    began_s: float
    status: str
    text: str
    cause: str

    @property
    def has_failed(self) -> bool:
        """Whether the activity failed or was cancelled."""
        return self.status in _FAILED


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudOverview:
    """The state of a deployment at one time.

    ``balancer`` is None if the group has none or it could not be read.  ``launched_s`` maps an instance to
    the time of its launch (Unix seconds); ``activities`` are the newest scaling activities, oldest first;
    ``problems`` are sentences about parts that could not be read.
    """

    group: AutoScalingGroup
    balancer: CloudBalancer | None
    launched_s: dict[str, float]
    activities: tuple[ScalingActivity, ...]
    problems: tuple[str, ...] = ()


def read_overview(account: Account, settings: PlatformSettings, *, now: datetime) -> CloudOverview:
    """Return the state of the deployment at *now* (UTC), without its robots.

    Raises:
        ConfigurationError: There is no group in the region, or AWS does not allow to describe it.
        StoreError: AWS does not answer.
    """
    group = read_group(account, settings, now=now, asks_robots=False)
    problems: list[str] = []
    names = [server.name for server in group.servers]
    return CloudOverview(
        group=group,
        balancer=_read_or_note_problem(problems, None, lambda: _read_balancer(account, group.target_groups)),
        launched_s=_read_or_note_problem(problems, {}, lambda: _read_launch_times_s(account, names)),
        activities=_read_or_note_problem(
            problems, (), lambda: _read_activities(account, ResourceNames(settings.cloud.name).group)
        ),
        problems=tuple(problems),
    )


def _read_or_note_problem(problems: list[str], otherwise: T, read: Callable[[], T]) -> T:
    try:
        return read()
    except RsePfError as error:
        problems.append(error.message)
        return otherwise


def _read_balancer(account: Account, target_groups: tuple[str, ...]) -> CloudBalancer | None:
    if not target_groups:
        return None
    groups = account.pages(
        "elbv2", "describe_target_groups", "TargetGroups", TargetGroupArns=list(target_groups)
    )
    arns = sorted({arn for group in groups for arn in group["LoadBalancerArns"]})
    if not arns:
        return None
    balancers = account.pages("elbv2", "describe_load_balancers", "LoadBalancers", LoadBalancerArns=arns[:1])
    listeners = account.pages("elbv2", "describe_listeners", "Listeners", LoadBalancerArn=arns[0])
    return CloudBalancer(
        state=str(balancers[0]["State"]["Code"]),
        address=str(balancers[0]["DNSName"]),
        protocols=tuple(sorted({str(listener["Protocol"]) for listener in listeners})),
    )


def _read_launch_times_s(account: Account, names: list[str]) -> dict[str, float]:
    if not names:
        return {}
    # A filter is used, since an InstanceId parameter with the id of a terminated instance would be an error.
    rows = account.pages(
        "ec2",
        "describe_instances",
        "Reservations",
        Filters=[{"Name": "instance-id", "Values": names[:_MAX_FILTER_VALUES]}],
    )
    return {
        str(instance["InstanceId"]): instance["LaunchTime"].timestamp()
        for row in rows
        for instance in row["Instances"]
    }


def _read_activities(account: Account, group: str) -> tuple[ScalingActivity, ...]:
    answer = account.find(
        "autoscaling", "describe_scaling_activities", AutoScalingGroupName=group, MaxRecords=_MAX_ACTIVITIES
    )
    rows = (answer or {}).get("Activities", ())
    return tuple(
        sorted(
            (
                ScalingActivity(
                    id=str(row["ActivityId"]),
                    began_s=row["StartTime"].timestamp(),
                    status=str(row["StatusCode"]),
                    text=str(row.get("Description", "")),
                    cause=str(row.get("Cause", "")),
                )
                for row in rows
            ),
            key=lambda activity: (activity.began_s, activity.id),
        )
    )
