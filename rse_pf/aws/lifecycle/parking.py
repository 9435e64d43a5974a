"""Set the sizes of a deployment's groups to 0, note the former sizes, and restore them.

The operator's commands and the function of the idle timer and the schedule use the same calls.  The IAM role
of that function allows no other changes.
"""

from __future__ import annotations

import msgspec

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle.deployment import ParkNote, read_note, read_sizes
from rse_pf.aws.lifecycle.plan import size_to_restore
from rse_pf.config.resource_names import ResourceNames

__all__ = [
    "delete_note",
    "empty_group",
    "enable_alarms",
    "fill_groups",
    "silence_alarms",
    "write_note",
]

_SUSPENDED_PROCESSES = ("AlarmNotification", "ScheduledActions")
"""Auto Scaling processes that are suspended in a parked group, so that no alarm or schedule adds servers."""

# Most alarms whose actions one call enables or disables: AWS takes no more.
_MAX_ALARMS_PER_CALL = 100


def write_note(account: Account, names: ResourceNames, note: ParkNote) -> None:
    """Store *note* in the SSM parameter, in place of an existing note; raises as `Account.change`."""
    value = msgspec.json.encode(note).decode()
    account.change("ssm", "put_parameter", Name=names.parked, Value=value, Type="String", Overwrite=True)


def delete_note(account: Account, names: ResourceNames) -> None:
    """Delete the note, so that the deployment counts as not parked; raises the errors of `Account.find`."""
    account.find("ssm", "delete_parameter", Name=names.parked)


def silence_alarms(account: Account, names: ResourceNames) -> None:
    """Disable the actions, and so the notifications, of all alarms of the deployment.

    Raises the errors of `Account.change`.
    """
    for some in _alarms_of_deployment(account, names):
        account.change("cloudwatch", "disable_alarm_actions", AlarmNames=some)


def enable_alarms(account: Account, names: ResourceNames) -> None:
    """Enable the actions, and so the notifications, of all alarms of the deployment.

    Raises the errors of `Account.change`.
    """
    for some in _alarms_of_deployment(account, names):
        account.change("cloudwatch", "enable_alarm_actions", AlarmNames=some)


def empty_group(account: Account, group: str) -> None:
    """Suspend the processes that add servers to *group*, and set its size to 0, so that its servers drain.

    Raises the errors of `Account.change`.
    """
    account.change(
        "autoscaling",
        "suspend_processes",
        AutoScalingGroupName=group,
        ScalingProcesses=list(_SUSPENDED_PROCESSES),
    )
    account.change(
        "autoscaling", "update_auto_scaling_group", AutoScalingGroupName=group,
        MinSize=0, DesiredCapacity=0, MaxSize=0,
    )  # fmt: skip


def fill_groups(account: Account, names: ResourceNames, *, least: int = 0) -> None:
    """Restore the noted sizes of the groups, and resume the processes that add servers.

    The group of backend servers gets a minimum of at least *least*, but not above its maximum.  A group whose
    maximum is not 0 keeps its size.  Raises the errors of `Account.change`.
    """
    note = read_note(account, names)
    for name, now in read_sizes(account, names).items():
        size = size_to_restore(note.groups.get(name) if note is not None else None, now)
        if size is not None:
            floor = max(size.min_servers, least) if name == names.group else size.min_servers
            floor = min(floor, size.max_servers)
            account.change(
                "autoscaling", "update_auto_scaling_group", AutoScalingGroupName=name, MinSize=floor,
                DesiredCapacity=min(max(size.wanted_servers, floor), size.max_servers),
                MaxSize=size.max_servers,
            )  # fmt: skip
        account.change(
            "autoscaling",
            "resume_processes",
            AutoScalingGroupName=name,
            ScalingProcesses=list(_SUSPENDED_PROCESSES),
        )


def _alarms_of_deployment(account: Account, names: ResourceNames) -> list[list[str]]:
    """Return the names of the deployment's alarms, in lists of at most `_MAX_ALARMS_PER_CALL`."""
    rows = account.pages("cloudwatch", "describe_alarms", "MetricAlarms", AlarmNamePrefix=names.alarm_prefix)
    alarm_names = [str(row["AlarmName"]) for row in rows]
    return [
        alarm_names[at : at + _MAX_ALARMS_PER_CALL] for at in range(0, len(alarm_names), _MAX_ALARMS_PER_CALL)
    ]
