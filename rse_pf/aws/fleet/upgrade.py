"""Replace the servers by those of the newest launch template, and roll a bad release back.

1. AWS replaces the servers by an instance refresh: a new server is in service before an old one is drained.
2. If an alarm of `WATCHED` fires or a launch fails, AWS returns the group to the previous version.
3. Otherwise the version is written into the stack's parameter, so that the next deployment keeps it.

Every step can be repeated: an interrupted run is followed or finished by the next one.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import Enum
from typing import Any

from rse_pf.aws.account import Account
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import VERSION_PARAMETER, ResourceNames
from rse_pf.errors import ConfigurationError, RsePfError
from rse_pf.scaling.health import MAX_HEALTHY_PERCENT

__all__ = [
    "Release",
    "State",
    "UpgradeStep",
    "Upgraded",
    "find_failed_launch",
    "next_step",
    "preferences",
    "read_state",
    "state_of_refresh",
    "upgrade",
    "versions_behind",
    "with_version",
]

WATCHED = ("errors", "unhealthy", "few-servers", "store")
"""Alarms that end an upgrade; one that fires already when it begins is left out."""
# Time between two reads of the refresh, in seconds: it changes about once a minute.
POLL_S = 10.0
_ACTIVE = ("Pending", "InProgress", "Baking", "Cancelling", "RollbackInProgress")
_ABANDONED = ("Cancelled", "Failed")
_LIFECYCLE = "Lifecycle Action"
# Last lines of a console that are shown: an error with its traceback.
_CONSOLE_LINES = 12
_NOT_LISTED: Mapping[str, Any] = {"Status": "Pending"}
"""Stands for a refresh that AWS has just started and does not list yet."""
_STACK_BUSY = "_IN_PROGRESS"
# Reads of the stack before an update counts as failed: half an hour.
_STACK_POLLS = 180


class State(Enum):
    """State of an instance refresh."""

    RUNNING = "running"
    ROLLING_BACK = "rolling back"
    DONE = "done"
    ROLLED_BACK = "rolled back"
    FAILED = "failed"


class UpgradeStep(Enum):
    """Next step of an upgrade."""

    FOLLOW = "follow the refresh that runs"
    REFRESH = "replace the servers"
    RECORD = "write the version into the stack"
    NOTHING = "nothing"


@dataclass(frozen=True, slots=True, kw_only=True)
class Release:
    """Versions of the launch template: the newest, of the group, of each instance, and of the stack."""

    newest: str
    group: str
    instances: tuple[str, ...]
    recorded: str
    refresh: Mapping[str, Any] | None
    raw_group: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Upgraded:
    """How an upgrade ended; *reason* is empty when every server runs *version*."""

    version: str
    replaced: bool
    reason: str = ""
    console: tuple[str, ...] = ()


def next_step(release: Release) -> UpgradeStep:
    """Return what brings every server, and then the stack, to the newest version."""
    if release.refresh is not None and release.refresh["Status"] in _ACTIVE:
        return UpgradeStep.FOLLOW
    if release.group != release.newest or any(version != release.newest for version in release.instances):
        return UpgradeStep.REFRESH
    return UpgradeStep.NOTHING if release.recorded == release.newest else UpgradeStep.RECORD


def state_of_refresh(refresh: Mapping[str, Any]) -> State:
    """Return the state of an instance refresh as AWS describes it."""
    status = refresh["Status"]
    if status == "RollbackInProgress":
        return State.ROLLING_BACK
    if status in _ACTIVE:
        return State.RUNNING
    return {"Successful": State.DONE, "RollbackSuccessful": State.ROLLED_BACK}.get(status, State.FAILED)


def find_failed_launch(activities: Sequence[Mapping[str, Any]], since: datetime) -> Mapping[str, Any] | None:
    """Return the first launch since *since* that was abandoned, None if there is none.

    A launch that failed for lack of capacity does not count: AWS repeats it, and no release causes it.
    """
    failed = [
        activity
        for activity in activities
        if activity["StartTime"] >= since
        and activity["StatusCode"] in _ABANDONED
        and activity["Description"].startswith("Launching")
        and _LIFECYCLE in activity.get("StatusMessage", "")
    ]
    return min(failed, key=lambda activity: activity["StartTime"], default=None)


def with_version(group: Mapping[str, Any], version: str) -> dict[str, Any]:
    """Return the launch template or the mixed policy of *group* with *version*: a DesiredConfiguration."""
    if group.get("MixedInstancesPolicy"):
        policy = copy.deepcopy(dict(group["MixedInstancesPolicy"]))
        _drop_template_name(policy["LaunchTemplate"]["LaunchTemplateSpecification"])["Version"] = version
        return {"MixedInstancesPolicy": policy}
    return {"LaunchTemplate": {**_drop_template_name(dict(group["LaunchTemplate"])), "Version": version}}


def preferences(settings: PlatformSettings, alarms: Sequence[str]) -> dict[str, Any]:
    """Return the preferences of a refresh: start before end, watched by *alarms*, with rollback."""
    options: dict[str, Any] = {
        "MinHealthyPercentage": 100,
        "MaxHealthyPercentage": MAX_HEALTHY_PERCENT,
        "InstanceWarmup": settings.scaling.warm_up_s,
        "AutoRollback": True,
        "SkipMatching": True,
        "ScaleInProtectedInstances": "Refresh",
        "StandbyInstances": "Ignore",
    }
    return {**options, "AlarmSpecification": {"Alarms": list(alarms)}} if alarms else options


def read_state(account: Account, settings: PlatformSettings) -> Release:
    """Return the versions of a deployment; raises ConfigurationError where nothing is deployed."""
    names = ResourceNames(settings.cloud.name)
    group = _read_group(account, names)
    refreshes = account.pages(
        "autoscaling", "describe_instance_refreshes", "InstanceRefreshes", AutoScalingGroupName=names.group
    )
    versions = [instance.get("LaunchTemplate", {}).get("Version", "") for instance in group["Instances"]]
    return Release(
        newest=_read_newest_version(account, group),
        group=str(_specification(group).get("Version", "")),
        instances=tuple(versions),
        recorded=_read_parameters(account, names).get(VERSION_PARAMETER, ""),
        refresh=max(refreshes, key=_refresh_order, default=None),
        raw_group=group,
    )


def versions_behind(account: Account, settings: PlatformSettings) -> tuple[str, str] | None:
    """Return the version that the group names and the newest one, None where they are the same.

    Raises:
        ConfigurationError: Nothing is deployed, or AWS refused.
        StoreError: AWS does not answer.
    """
    group = _read_group(account, ResourceNames(settings.cloud.name))
    newest, named = _read_newest_version(account, group), str(_specification(group).get("Version", ""))
    return None if named == newest else (named, newest)


def upgrade(
    account: Account,
    settings: PlatformSettings,
    *,
    tell: Callable[[str], None],
    sleep: Callable[[float], None],
    now: Callable[[], datetime],
) -> Upgraded:
    """Bring every server to the newest version, or back to the previous one; return the result.

    Args:
        account: Of the deployment.
        settings: Of the platform.
        tell: Called with each line of progress.
        sleep: Waits between two looks; it may raise KeyboardInterrupt, and AWS then goes on by itself.
        now: The time in UTC.

    Raises:
        ConfigurationError: Nothing is deployed, or AWS refused.
        StoreError: AWS does not answer.
    """
    release = read_state(account, settings)
    step = next_step(release)
    version, replaced, identity = release.newest, False, ""
    if step in (UpgradeStep.REFRESH, UpgradeStep.FOLLOW):
        begun = now()
        if step is UpgradeStep.FOLLOW and release.refresh is not None:
            tell("a refresh runs already; following it")
            begun = release.refresh.get("StartTime", begun)
            version = _version_of(release.refresh) or version
            identity = release.refresh["InstanceRefreshId"]
        elif release.raw_group["Instances"]:
            identity = _start_refresh(account, settings, release, tell)
        else:
            account.change(
                "autoscaling", "update_auto_scaling_group",
                AutoScalingGroupName=release.raw_group["AutoScalingGroupName"],
                **with_version(release.raw_group, version),
            )  # fmt: skip
        if release.raw_group["Instances"]:
            ended = _follow_refresh(account, settings, identity, begun, tell, sleep)
            if ended.reason:
                return ended
            replaced = True
        step = UpgradeStep.RECORD
    if step is UpgradeStep.RECORD:
        _record_version(account, settings, version, sleep)
        tell(f"the stack names version {version}")
    return Upgraded(version=version, replaced=replaced)


def _start_refresh(
    account: Account, settings: PlatformSettings, release: Release, tell: Callable[[str], None]
) -> str:
    """Start an instance refresh; return its id."""
    names = ResourceNames(settings.cloud.name)
    watched_alarms = {names.alarm(name): name for name in WATCHED}
    rows = account.pages("cloudwatch", "describe_alarms", "MetricAlarms", AlarmNames=list(watched_alarms))
    firing = sorted(watched_alarms[alarm["AlarmName"]] for alarm in rows if alarm["StateValue"] == "ALARM")
    quiet = sorted(alarm["AlarmName"] for alarm in rows if alarm["StateValue"] != "ALARM")
    for name in firing:
        tell(f"alarm {name} fires already, so it does not end this upgrade")
    tell(f"replacing servers: version {release.group} by {release.newest}")
    started = account.change(
        "autoscaling", "start_instance_refresh", AutoScalingGroupName=names.group, Strategy="Rolling",
        DesiredConfiguration=with_version(release.raw_group, release.newest),
        Preferences=preferences(settings, quiet),
    )  # fmt: skip
    return str(started["InstanceRefreshId"])


def _follow_refresh(
    account: Account,
    settings: PlatformSettings,
    identity: str,
    begun: datetime,
    tell: Callable[[str], None],
    sleep: Callable[[float], None],
) -> Upgraded:
    """Report the progress until the refresh *identity* has ended; roll back at once when a launch fails."""
    names = ResourceNames(settings.cloud.name)
    last_line, cause = "", ""
    console: tuple[str, ...] = ()
    while True:
        rows = account.pages(
            "autoscaling", "describe_instance_refreshes", "InstanceRefreshes",
            AutoScalingGroupName=names.group, InstanceRefreshIds=[identity],
        )  # fmt: skip
        refresh = rows[0] if rows else _NOT_LISTED
        state = state_of_refresh(refresh)
        line = f"{state.value}: {refresh.get('PercentageComplete', 0)} %"
        if line != last_line:
            tell(line)
            last_line = line
        if state is State.DONE:
            return Upgraded(version=_version_of(refresh), replaced=True)
        if state in (State.ROLLED_BACK, State.FAILED):
            reason = cause or str(refresh.get("StatusReason", "")) or "AWS gives no reason"
            return Upgraded(
                version=_version_of(refresh),
                replaced=False,
                reason=f"{state.value}: {reason}",
                console=console,
            )
        if state is State.RUNNING and not cause:
            failed = _read_failed_launch(account, names, begun)
            if failed is not None:
                cause = str(failed.get("StatusMessage") or failed["Description"])
                console = _read_console(account, failed)
                tell(f"a new server did not become ready: {cause}")
                account.find("autoscaling", "rollback_instance_refresh", AutoScalingGroupName=names.group)
        sleep(POLL_S)


def _refresh_order(refresh: Mapping[str, Any]) -> tuple[bool, str]:
    """Return a key that sorts the newest refresh to the end; one that waits may have no start yet."""
    return refresh["Status"] in _ACTIVE, str(refresh.get("StartTime", ""))


def _read_failed_launch(account: Account, names: ResourceNames, begun: datetime) -> Mapping[str, Any] | None:
    answer = account.find(
        "autoscaling", "describe_scaling_activities", AutoScalingGroupName=names.group, MaxRecords=50
    )
    return find_failed_launch((answer or {}).get("Activities", ()), begun)


def _read_console(account: Account, activity: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the last console lines of the machine of *activity*; none if AWS does not have them."""
    words = [word.strip(".,") for word in str(activity["Description"]).split()]
    instance = next((word for word in words if word.startswith("i-")), "")
    if not instance:
        return ()
    try:
        output = account.find("ec2", "get_console_output", InstanceId=instance, Latest=True) or {}
    except RsePfError:
        return ()  # the machine is gone, or this type of machine has no console
    lines = [line.strip() for line in str(output.get("Output", "")).splitlines() if line.strip()]
    ours = [line for line in lines if "rse-pf" in line]
    return tuple((ours or lines)[-_CONSOLE_LINES:])


def _record_version(
    account: Account, settings: PlatformSettings, version: str, sleep: Callable[[float], None]
) -> None:
    """Write *version* into the parameter of the stack, whose template stays as it is."""
    names = ResourceNames(settings.cloud.name)
    parameters = _read_parameters(account, names)
    if VERSION_PARAMETER not in parameters:
        raise ConfigurationError(
            f"the stack {names.stack('Backend')} has no parameter {VERSION_PARAMETER}",
            hint="it was deployed by an older release: deploy it again, then repeat rse-pf cloud upgrade",
        )
    if parameters[VERSION_PARAMETER] == version:
        return
    previous: list[dict[str, Any]] = [
        {"ParameterKey": name, "UsePreviousValue": True} for name in parameters if name != VERSION_PARAMETER
    ]
    account.change(
        "cloudformation", "update_stack", StackName=names.stack("Backend"), UsePreviousTemplate=True,
        Capabilities=["CAPABILITY_IAM", "CAPABILITY_NAMED_IAM"],
        Parameters=[*previous, {"ParameterKey": VERSION_PARAMETER, "ParameterValue": version}],
    )  # fmt: skip
    for _ in range(_STACK_POLLS):
        stack = _read_stack(account, names)
        if not stack["StackStatus"].endswith(_STACK_BUSY):
            break
        sleep(POLL_S)
    if _read_parameters(account, names).get(VERSION_PARAMETER) != version:
        raise ConfigurationError(
            f"the servers run version {version}, and the stack does not name it: {stack['StackStatus']}",
            hint="repeat rse-pf cloud upgrade before the next deployment",
        )


def _read_group(account: Account, names: ResourceNames) -> Mapping[str, Any]:
    groups = account.pages(
        "autoscaling",
        "describe_auto_scaling_groups",
        "AutoScalingGroups",
        AutoScalingGroupNames=[names.group],
    )
    if not groups:
        raise ConfigurationError(f"no platform runs in {account.region}", hint="deploy it: rse-pf cloud up")
    group: Mapping[str, Any] = groups[0]
    return group


def _read_newest_version(account: Account, group: Mapping[str, Any]) -> str:
    templates = account.change(
        "ec2", "describe_launch_templates", LaunchTemplateIds=[_specification(group)["LaunchTemplateId"]]
    )
    return str(templates["LaunchTemplates"][0]["LatestVersionNumber"])


def _read_stack(account: Account, names: ResourceNames) -> dict[str, Any]:
    answer = account.change("cloudformation", "describe_stacks", StackName=names.stack("Backend"))
    stack: dict[str, Any] = answer["Stacks"][0]
    return stack


def _read_parameters(account: Account, names: ResourceNames) -> dict[str, str]:
    rows = _read_stack(account, names).get("Parameters", ())
    return {row["ParameterKey"]: row["ParameterValue"] for row in rows}


def _specification(group: Mapping[str, Any]) -> Mapping[str, Any]:
    if group.get("MixedInstancesPolicy"):
        mixed: Mapping[str, Any] = group["MixedInstancesPolicy"]["LaunchTemplate"][
            "LaunchTemplateSpecification"
        ]
        return mixed
    plain: Mapping[str, Any] = group["LaunchTemplate"]
    return plain


def _drop_template_name(specification: dict[str, Any]) -> dict[str, Any]:
    """Leave the name out: AWS takes the id or the name, and describes both."""
    specification.pop("LaunchTemplateName", None)
    return specification


def _version_of(refresh: Mapping[str, Any]) -> str:
    """Return the version that a refresh leads to; empty where it names none."""
    desired = refresh.get("DesiredConfiguration") or {}
    return str(_specification(desired).get("Version", "")) if desired else ""
