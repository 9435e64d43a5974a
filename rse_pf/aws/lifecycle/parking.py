"""End all servers of a deployment, and note what is needed to bring them back.

An operator's command and the idle timer use the same calls; the timer's role allows no others.
"""

from __future__ import annotations

import msgspec

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle.deployment import ParkNote
from rse_pf.config.resource_names import ResourceNames

__all__ = ["SUSPENDED", "alarms_of_deployment", "empty_group", "silence_alarms", "write_note"]

SUSPENDED = ("AlarmNotification", "ScheduledActions")
"""Processes of a parked group: neither an alarm nor a schedule starts a server."""

_ALARMS_OF_A_CALL = 100


def write_note(account: Account, names: ResourceNames, note: ParkNote) -> None:
    """Write *note* over the one that is there; raises ConfigurationError."""
    value = msgspec.json.encode(note).decode()
    account.change("ssm", "put_parameter", Name=names.parked, Value=value, Type="String", Overwrite=True)


def silence_alarms(account: Account, names: ResourceNames) -> None:
    """Let no alarm of the deployment act or notify; raises as `Account.find`."""
    for some in alarms_of_deployment(account, names):
        account.change("cloudwatch", "disable_alarm_actions", AlarmNames=some)


def empty_group(account: Account, group: str) -> None:
    """Suspend what starts servers in *group*, and end all of its servers; raises as `Account.find`."""
    account.change(
        "autoscaling", "suspend_processes", AutoScalingGroupName=group, ScalingProcesses=list(SUSPENDED)
    )
    account.change(
        "autoscaling", "update_auto_scaling_group", AutoScalingGroupName=group,
        MinSize=0, DesiredCapacity=0, MaxSize=0,
    )  # fmt: skip


def alarms_of_deployment(account: Account, names: ResourceNames) -> list[list[str]]:
    """Return the names of the deployment's alarms, in portions that one call takes."""
    rows = account.pages("cloudwatch", "describe_alarms", "MetricAlarms", AlarmNamePrefix=names.alarm_prefix)
    found = [str(row["AlarmName"]) for row in rows]
    return [found[at : at + _ALARMS_OF_A_CALL] for at in range(0, len(found), _ALARMS_OF_A_CALL)]
