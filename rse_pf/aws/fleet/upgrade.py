"""Replace the servers by those of the newest launch template, and roll a bad release back.

1. AWS replaces the servers by an instance refresh: a new server is in service before an old one is drained.
2. If an alarm of `WATCHED` fires or a launch fails, AWS returns the group to the previous version.
3. Otherwise the version is written into the stack's parameter, so that the next deployment keeps it.

Every step can be repeated: after an interruption, the next call of `upgrade` continues.
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
"""Alarms that roll an upgrade back when they fire; an alarm that fires already at its begin is left out."""
# Time between two reads of the refresh's or the stack's state, in seconds: it changes about once a minute.
POLL_S = 10.0
# States of an instance refresh that has not ended.
_ACTIVE_STATES = ("Pending", "InProgress", "Baking", "Cancelling", "RollbackInProgress")
_FAILED_ACTIVITIES = ("Cancelled", "Failed")  # states of a scaling activity that failed
_HOOK_MESSAGE = "Lifecycle Action"  # part of AWS's message if an activity failed because of its hook
# Number of console lines of a failed server that are shown, the last ones: an error with its traceback.
_CONSOLE_LINES = 12
_UNLISTED_REFRESH: Mapping[str, Any] = {"Status": "Pending"}
"""Description of a refresh that AWS has just started and does not list yet."""
_STACK_BUSY_SUFFIX = "_IN_PROGRESS"  # ending of the states of a stack that AWS still changes
# Number of reads of the stack, `POLL_S` apart, before an update counts as failed: half an hour.
_STACK_POLLS = 180


class State(Enum):
    """The state of an instance refresh, which replaces the servers of the group."""

    RUNNING = "running"
    ROLLING_BACK = "rolling back"
    DONE = "done"
    ROLLED_BACK = "rolled back"
    FAILED = "failed"


class UpgradeStep(Enum):
    """The next step of an upgrade."""

    FOLLOW = "follow the refresh that runs"
    REFRESH = "replace the servers"
    RECORD = "write the version into the stack"
    NOTHING = "nothing"


@dataclass(frozen=True, slots=True, kw_only=True)
class Release:
    """The versions of the launch template in a deployment.

    Attributes:
        newest: The newest version that exists.
        group: The version with which the group launches instances.
        instances: The version of each instance.
        recorded: The version in the stack's parameter.
        refresh: The newest instance refresh as AWS describes it; None if there was none.
        raw_group: The Auto Scaling group as AWS describes it.
    """

    newest: str
    group: str
    instances: tuple[str, ...]
    recorded: str
    refresh: Mapping[str, Any] | None
    raw_group: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Upgraded:
    """The result of an upgrade.

    Attributes:
        version: The version to which the upgrade led.
        replaced: Whether servers were replaced.
        reason: Why the upgrade failed or was rolled back; empty if every server runs *version*.
        console: The last console lines of a server that did not become ready.
    """

    version: str
    replaced: bool
    reason: str = ""
    console: tuple[str, ...] = ()


def next_step(release: Release) -> UpgradeStep:
    """Return the next step towards a deployment whose servers and stack have the newest version."""
    if release.refresh is not None and release.refresh["Status"] in _ACTIVE_STATES:
        return UpgradeStep.FOLLOW
    if release.group != release.newest or any(version != release.newest for version in release.instances):
        return UpgradeStep.REFRESH
    return UpgradeStep.NOTHING if release.recorded == release.newest else UpgradeStep.RECORD


def state_of_refresh(refresh: Mapping[str, Any]) -> State:
    """Return the state of *refresh*, which is an instance refresh in AWS's description."""
    status = refresh["Status"]
    if status == "RollbackInProgress":
        return State.ROLLING_BACK
    if status in _ACTIVE_STATES:
        return State.RUNNING
    return {"Successful": State.DONE, "RollbackSuccessful": State.ROLLED_BACK}.get(status, State.FAILED)


def find_failed_launch(activities: Sequence[Mapping[str, Any]], since: datetime) -> Mapping[str, Any] | None:
    """Return the first scaling activity since *since* whose launch hook failed; None if there is none.

    A launch that failed for lack of capacity does not count: AWS repeats it, and no release causes it.
    """
    failed = [
        activity
        for activity in activities
        if activity["StartTime"] >= since
        and activity["StatusCode"] in _FAILED_ACTIVITIES
        and activity["Description"].startswith("Launching")
        and _HOOK_MESSAGE in activity.get("StatusMessage", "")
    ]
    return min(failed, key=lambda activity: activity["StartTime"], default=None)


def with_version(group: Mapping[str, Any], version: str) -> dict[str, Any]:
    """Return the DesiredConfiguration of a refresh: the template or policy of *group* with *version*."""
    if group.get("MixedInstancesPolicy"):
        policy = copy.deepcopy(dict(group["MixedInstancesPolicy"]))
        _drop_template_name(policy["LaunchTemplate"]["LaunchTemplateSpecification"])["Version"] = version
        return {"MixedInstancesPolicy": policy}
    return {"LaunchTemplate": {**_drop_template_name(dict(group["LaunchTemplate"])), "Version": version}}


def preferences(settings: PlatformSettings, alarms: Sequence[str]) -> dict[str, Any]:
    """Return the preferences of a refresh: launch before terminating, and roll back when *alarms* fire."""
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
    """Return the versions of a deployment; raises ConfigurationError if nothing is deployed."""
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
    """Return the group's version and the newest version of the launch template; None if they are the same.

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
    report_progress: Callable[[str], None],
    sleep: Callable[[float], None],
    now: Callable[[], datetime],
) -> Upgraded:
    """Bring every server to the newest version, or back to the previous one; return the result.

    Args:
        account: AWS account of the deployment.
        settings: Settings of the platform.
        report_progress: Called with each line of progress.
        sleep: Waits between two reads of the state; after a KeyboardInterrupt AWS continues by itself.
        now: Returns the time in UTC.

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
            report_progress("a refresh runs already; following it")
            begun = release.refresh.get("StartTime", begun)
            version = _version_of(release.refresh) or version
            identity = release.refresh["InstanceRefreshId"]
        elif release.raw_group["Instances"]:
            identity = _start_refresh(account, settings, release, report_progress)
        else:
            account.change(
                "autoscaling", "update_auto_scaling_group",
                AutoScalingGroupName=release.raw_group["AutoScalingGroupName"],
                **with_version(release.raw_group, version),
            )  # fmt: skip
        if release.raw_group["Instances"]:
            ended = _follow_refresh(account, settings, identity, begun, report_progress, sleep)
            if ended.reason:
                return ended
            replaced = True
        step = UpgradeStep.RECORD
    if step is UpgradeStep.RECORD:
        _record_version(account, settings, version, sleep)
        report_progress(f"the stack names version {version}")
    return Upgraded(version=version, replaced=replaced)


def _start_refresh(
    account: Account, settings: PlatformSettings, release: Release, report_progress: Callable[[str], None]
) -> str:
    """Start an instance refresh to the newest version, watched by the alarms of `WATCHED`; return its id."""
    names = ResourceNames(settings.cloud.name)
    watched_alarms = {names.alarm(name): name for name in WATCHED}
    rows = account.pages("cloudwatch", "describe_alarms", "MetricAlarms", AlarmNames=list(watched_alarms))
    firing = sorted(watched_alarms[alarm["AlarmName"]] for alarm in rows if alarm["StateValue"] == "ALARM")
    quiet = sorted(alarm["AlarmName"] for alarm in rows if alarm["StateValue"] != "ALARM")
    for name in firing:
        report_progress(f"alarm {name} fires already, so it does not end this upgrade")
    report_progress(f"replacing servers: version {release.group} by {release.newest}")
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
    report_progress: Callable[[str], None],
    sleep: Callable[[float], None],
) -> Upgraded:
    """Report the progress until the refresh *identity* has ended, and return its result.

    Order AWS to roll back as soon as a launch has failed since *begun*.
    """
    names = ResourceNames(settings.cloud.name)
    last_line, cause = "", ""
    console: tuple[str, ...] = ()
    while True:
        rows = account.pages(
            "autoscaling", "describe_instance_refreshes", "InstanceRefreshes",
            AutoScalingGroupName=names.group, InstanceRefreshIds=[identity],
        )  # fmt: skip
        refresh = rows[0] if rows else _UNLISTED_REFRESH
        state = state_of_refresh(refresh)
        line = f"{state.value}: {refresh.get('PercentageComplete', 0)} %"
        if line != last_line:
            report_progress(line)
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
                report_progress(f"a new server did not become ready: {cause}")
                account.find("autoscaling", "rollback_instance_refresh", AutoScalingGroupName=names.group)
        sleep(POLL_S)


def _refresh_order(refresh: Mapping[str, Any]) -> tuple[bool, str]:
    """Return a sort key, greatest for the newest refresh; an active refresh may have no start time yet."""
    return refresh["Status"] in _ACTIVE_STATES, str(refresh.get("StartTime", ""))


def _read_failed_launch(account: Account, names: ResourceNames, begun: datetime) -> Mapping[str, Any] | None:
    answer = account.find(
        "autoscaling", "describe_scaling_activities", AutoScalingGroupName=names.group, MaxRecords=50
    )
    return find_failed_launch((answer or {}).get("Activities", ()), begun)


def _read_console(account: Account, activity: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the last console lines of the machine that *activity* names; none if AWS does not have them."""
    words = [word.strip(".,") for word in str(activity["Description"]).split()]
    instance = next((word for word in words if word.startswith("i-")), "")
    if not instance:
        return ()
    try:
        output = account.find("ec2", "get_console_output", InstanceId=instance, Latest=True) or {}
    except RsePfError:
        return ()  # the machine was terminated, or its type has no console
    lines = [line.strip() for line in str(output.get("Output", "")).splitlines() if line.strip()]
    ours = [line for line in lines if "rse-pf" in line]
    return tuple((ours or lines)[-_CONSOLE_LINES:])


def _record_version(
    account: Account, settings: PlatformSettings, version: str, sleep: Callable[[float], None]
) -> None:
    """Update the backend stack's version parameter to *version*, with its template unchanged, and wait.

    Raises:
        ConfigurationError: The stack has no such parameter, or does not have the value after the update.
    """
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
        if not stack["StackStatus"].endswith(_STACK_BUSY_SUFFIX):
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
    """Remove the template's name from *specification*: AWS describes id and name, but takes only one."""
    specification.pop("LaunchTemplateName", None)
    return specification


def _version_of(refresh: Mapping[str, Any]) -> str:
    """Return the launch template version to which *refresh* leads; empty if it names none."""
    desired = refresh.get("DesiredConfiguration") or {}
    return str(_specification(desired).get("Version", "")) if desired else ""
