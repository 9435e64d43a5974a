"""Park a deployment that nobody has used for `IDLE_HOURS`, and resume a parked one by its schedule.

The function runs in AWS Lambda: each hour if ``cloud.idle_action`` says so, and at the entries of
``scaling.schedule`` that resume.  It may read metrics, and change the sizes of its own groups, which
terminates and launches servers.  It can delete nothing but the note that the deployment is parked, so that
``rse-pf cloud resume`` undoes its mistakes.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.metrics import ROBOTS, dimensions_of
from rse_pf.aws.lifecycle.deployment import GroupSize, ParkNote, read_note, read_sizes
from rse_pf.aws.lifecycle.parking import (
    delete_note,
    empty_group,
    enable_alarms,
    fill_groups,
    silence_alarms,
    write_note,
)
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.config.cloud_layout import IDLE_HOURS, RESUME_FIELD
from rse_pf.config.resource_names import ResourceNames
from rse_pf.scaling.alarms import NAMESPACE

__all__ = ["Hour", "handler", "is_idle", "park_if_idle", "resume_if_parked"]

_log = logging.getLogger(__name__)
_log.setLevel(logging.INFO)

_HOUR_S = 3600


@dataclass(frozen=True, slots=True, kw_only=True)
class Hour:
    """The metrics of the group in one hour; None if no agent published the metric in that hour."""

    requests: float | None
    """Number of requests to all servers."""
    robots: float | None
    """Mean number of robots on all servers together, over the hour."""


def is_idle(hours: Sequence[Hour]) -> bool:
    """Return whether there was no request and no robot in each of the last `IDLE_HOURS` of *hours*.

    *hours* are in order, oldest first.  An hour without metrics is not idle: silent agents are a failure, and
    a deployment that was created or resumed since then has not been idle for so long.
    """
    last = hours[-IDLE_HOURS:]
    return len(last) == IDLE_HOURS and all(hour.requests == 0 and hour.robots == 0 for hour in last)


def park_if_idle(account: Account, settings: PlatformSettings, *, now: datetime, topic: str) -> str:
    """Park the deployment if it is idle; return a line for the log that says what was done and why.

    Args:
        account: AWS account of the deployment.
        settings: Settings of the platform.
        now: The time in UTC.
        topic: ARN of the SNS topic that is notified before the deployment is parked.

    Raises:
        ConfigurationError: AWS refused.
        StoreError: AWS does not answer.
    """
    names = ResourceNames(settings.cloud.name)
    groups, note = read_sizes(account, names), read_note(account, names)
    if note is not None and (note.by != "timer" or not any(group.max_servers for group in groups.values())):
        return f"{names.prefix} is parked since {note.since}"
    hours = _read_hours(account, names, groups, IDLE_HOURS, now)
    if not is_idle(hours):
        return f"{names.prefix} was used within {IDLE_HOURS} hours, or some hours have no metrics"
    message = f"{names.prefix} was idle for {IDLE_HOURS} hours and is parked now; rse-pf cloud resume"
    # Notify first: if a later call fails, the repetition notifies again; once the groups are empty, it stops.
    account.change("sns", "publish", TopicArn=topic, Subject=f"{names.prefix} is parked", Message=message)
    if note is None:
        since = now.isoformat(timespec="seconds")
        write_note(account, names, ParkNote(groups=groups, since=since, by="timer"))
    silence_alarms(account, names)
    for group in groups:
        empty_group(account, group)
    return message


def resume_if_parked(account: Account, settings: PlatformSettings, *, least: int, topic: str) -> str:
    """Resume a parked deployment with at least *least* servers; return a line that says what was done.

    It does not matter whether the operator or the timer parked the deployment.  A deployment that is not
    parked, or is parked deeply and so has no stacks, stays as it is.

    Args:
        account: AWS account of the deployment.
        settings: Settings of the platform.
        least: Minimum size of the group of backend servers.
        topic: ARN of the SNS topic that is notified.

    Raises:
        ConfigurationError: AWS refused.
        StoreError: AWS does not answer.
    """
    names = ResourceNames(settings.cloud.name)
    note = read_note(account, names)
    if note is None or note.deep:
        return f"{names.prefix} is {'not parked' if note is None else 'parked deeply'}"
    message = (
        f"{names.prefix} was parked since {note.since}, and scaling.schedule resumes it: {least} servers"
    )
    fill_groups(account, names, least=least)
    enable_alarms(account, names)
    account.change("sns", "publish", TopicArn=topic, Subject=f"{names.prefix} is resumed", Message=message)
    delete_note(account, names)  # last: after a failure the next call resumes again
    return message


def handler(event: dict[str, Any], context: object) -> str:
    """Resume the deployment if *event* has the field `RESUME_FIELD`, else park it if it is idle.

    Return the line that was logged.
    """
    settings = load_settings(Path(__file__).parents[3] / "settings.json")
    account, topic = Account(settings.cloud.region), os.environ["RSE_PF_TOPIC"]
    if RESUME_FIELD in event:
        message = resume_if_parked(account, settings, least=int(event[RESUME_FIELD]), topic=topic)
    else:
        message = park_if_idle(account, settings, now=datetime.now(timezone.utc), topic=topic)
    _log.info(message)
    return message


def _read_hours(
    account: Account, names: ResourceNames, groups: dict[str, GroupSize], count: int, now: datetime
) -> list[Hour]:
    """Return the metrics of the last *count* whole hours before *now*, oldest first."""
    end_s = int(now.timestamp()) // _HOUR_S * _HOUR_S
    end = datetime.fromtimestamp(end_s, timezone.utc)
    values: dict[str, dict[int, float]] = {"requests": {}, "robots": {}}
    rows = account.pages(
        "cloudwatch", "get_metric_data", "MetricDataResults",
        MetricDataQueries=[
            _make_query(names.group, "requests", "Requests", "Sum"),
            _make_query(names.group, "robots", ROBOTS, "Average"),
        ],
        StartTime=end - timedelta(hours=count), EndTime=end, ScanBy="TimestampAscending",
    )  # fmt: skip
    for row in rows:
        for begin, value in zip(row["Timestamps"], row["Values"], strict=False):
            values[row["Id"]][int(begin.timestamp()) // _HOUR_S] = float(value)
    servers = max(1, groups[names.group].instances) if names.group in groups else 1
    hours = []
    for hour in range(end_s // _HOUR_S - count, end_s // _HOUR_S):
        mean = values["robots"].get(hour)
        robots = None if mean is None else mean * servers
        hours.append(Hour(requests=values["requests"].get(hour), robots=robots))
    return hours


def _make_query(group: str, identity: str, metric: str, statistic: str) -> dict[str, Any]:
    of_group = {"Namespace": NAMESPACE, "MetricName": metric, "Dimensions": dimensions_of(group)}
    return {
        "Id": identity, "MetricStat": {"Metric": of_group, "Period": _HOUR_S, "Stat": statistic},
    }  # fmt: skip
