"""End all servers of a deployment, note the sizes of its groups, and restore them.

An operator's commands, the idle timer and the schedule use the same calls; the role of the function allows no
others.
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

_SUSPENDED = ("AlarmNotification", "ScheduledActions")
"""Processes of a parked group: neither an alarm nor a scheduled action starts a server."""

# Alarms of one call that switches their actions: the most that AWS takes.
_ALARMS_OF_A_CALL = 100


def write_note(account: Account, names: ResourceNames, note: ParkNote) -> None:
    """Write *note*, in place of an existing one; raises ConfigurationError."""
    value = msgspec.json.encode(note).decode()
    account.change("ssm", "put_parameter", Name=names.parked, Value=value, Type="String", Overwrite=True)


def delete_note(account: Account, names: ResourceNames) -> None:
    """Delete the note: the deployment is not parked any more.  Raises as `Account.find`."""
    account.find("ssm", "delete_parameter", Name=names.parked)


def silence_alarms(account: Account, names: ResourceNames) -> None:
    """Disable the actions and notifications of all alarms of the deployment; raises as `Account.find`."""
    for some in _alarms_of_deployment(account, names):
        account.change("cloudwatch", "disable_alarm_actions", AlarmNames=some)


def enable_alarms(account: Account, names: ResourceNames) -> None:
    """Enable the actions and notifications of all alarms of the deployment; raises as `Account.find`."""
    for some in _alarms_of_deployment(account, names):
        account.change("cloudwatch", "enable_alarm_actions", AlarmNames=some)


def empty_group(account: Account, group: str) -> None:
    """Suspend the processes that start servers in *group*, and end its servers; raises as `Account.find`."""
    account.change(
        "autoscaling", "suspend_processes", AutoScalingGroupName=group, ScalingProcesses=list(_SUSPENDED)
    )
    account.change(
        "autoscaling", "update_auto_scaling_group", AutoScalingGroupName=group,
        MinSize=0, DesiredCapacity=0, MaxSize=0,
    )  # fmt: skip


def fill_groups(account: Account, names: ResourceNames, *, least: int = 0) -> None:
    """Give the groups their noted sizes back, and let them grow again.

    The group of the backend servers gets a minimum of *least* or more.  A group whose maximum is not 0 keeps
    its size.  Raises as `Account.find`.
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
            "autoscaling", "resume_processes", AutoScalingGroupName=name, ScalingProcesses=list(_SUSPENDED)
        )


def _alarms_of_deployment(account: Account, names: ResourceNames) -> list[list[str]]:
    """Return the names of the deployment's alarms, in portions that one call takes."""
    rows = account.pages("cloudwatch", "describe_alarms", "MetricAlarms", AlarmNamePrefix=names.alarm_prefix)
    alarm_names = [str(row["AlarmName"]) for row in rows]
    return [alarm_names[at : at + _ALARMS_OF_A_CALL] for at in range(0, len(alarm_names), _ALARMS_OF_A_CALL)]
