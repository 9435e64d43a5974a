"""Carry out the steps of a plan by calls to CloudFormation, Auto Scaling, CloudWatch and SSM.

Time is an argument.  `CdkTools` runs the CDK's command line and the build of the packages.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime, timezone

from rse_pf.aws.account import Account
from rse_pf.aws.fleet.group import read_group
from rse_pf.aws.lifecycle.cdk_tools import CdkTools
from rse_pf.aws.lifecycle.deployment import ParkNote, read_note, read_sizes
from rse_pf.aws.lifecycle.parking import (
    delete_note,
    empty_group,
    enable_alarms,
    fill_groups,
    silence_alarms,
    write_note,
)
from rse_pf.aws.lifecycle.plan import Action, Step
from rse_pf.aws.lifecycle.removal import erase_data, sweep
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.config.schedule import minimum_at, parse_schedule, zone_named
from rse_pf.errors import DeploymentFailed
from rse_pf.scaling.health import DRAIN_S, GRACE_S

__all__ = ["StepContext", "carry_out"]

# Time between two reads of the state of a stack or a group while a step waits for it, in seconds.
_POLL_S = 5.0
# Time limit of a change of a stack, in seconds: the load balancer and endpoints take up to half an hour.
_STACK_TIMEOUT_S = 2400.0
# Time limit until all servers are terminated, in seconds, in addition to `DRAIN_S`.
_EMPTY_TIMEOUT_S = 600.0
# Time limit until all wanted servers are healthy, in seconds, in addition to `GRACE_S`.
_HEALTHY_TIMEOUT_S = 600.0


@dataclass(frozen=True, kw_only=True)
class StepContext:
    """The account, settings, tools and clocks that steps use.

    ``report_progress`` shows a line of progress to the operator; ``clock`` returns monotonic seconds, ``now``
    UTC.
    """

    account: Account
    settings: PlatformSettings
    tools: CdkTools
    report_progress: Callable[[str], None]
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    now: Callable[[], datetime] = lambda: datetime.now(timezone.utc)

    @property
    def names(self) -> ResourceNames:
        """Return the names of the deployment's AWS resources."""
        return ResourceNames(self.settings.cloud.name)


def carry_out(steps: Iterable[Step], world: StepContext) -> None:
    """Carry out *steps* in order, and show the description of each step before it begins.

    Raises:
        DeploymentFailed: A stack could not be deployed or destroyed, or servers did not become healthy or
            were not terminated in time.
        ConfigurationError: AWS refused.
        StoreError: AWS does not answer.
    """
    for step in steps:
        world.report_progress(str(step))
        _EFFECTS[step.action](step, world)


def _build(step: Step, world: StepContext) -> None:
    world.tools.build()


def _bootstrap(step: Step, world: StepContext) -> None:
    world.tools.bootstrap()


def _deploy(step: Step, world: StepContext) -> None:
    world.tools.deploy(world.names.stack(step.box))


def _settle(step: Step, world: StepContext) -> None:
    _await_stack(world, world.names.stack(step.box))


def _destroy(step: Step, world: StepContext) -> None:
    stack = world.names.stack(step.box)
    world.account.find("cloudformation", "delete_stack", StackName=stack)
    status = _await_stack(world, stack)
    if status not in ("", "DELETE_COMPLETE"):
        raise DeploymentFailed(
            f"the stack {stack} is {status}: {_read_failure_reason(world.account, stack)}",
            hint="remove what the reason names, then repeat the command",
        )


def _await_stack(world: StepContext, stack: str) -> str:
    """Wait until AWS no longer changes *stack*, and return its status; "" if it does not exist.

    Raises:
        DeploymentFailed: The change took longer than `_STACK_TIMEOUT_S`.
    """
    deadline = world.clock() + _STACK_TIMEOUT_S
    while True:
        answer = world.account.find("cloudformation", "describe_stacks", StackName=stack)
        status = str(answer["Stacks"][0]["StackStatus"]) if answer and answer["Stacks"] else ""
        if not status.endswith("_IN_PROGRESS"):
            return status
        if world.clock() > deadline:
            raise DeploymentFailed(
                f"the stack {stack} is {status} after {_STACK_TIMEOUT_S:g} s",
                hint="look at its events in the console, then repeat the command",
            )
        world.sleep(_POLL_S)


def _read_failure_reason(account: Account, stack: str) -> str:
    """Return the resource that failed first in the events of *stack*, and CloudFormation's reason.

    Later failures are mostly consequences of the first one.
    """
    rows = account.pages("cloudformation", "describe_stack_events", "StackEvents", StackName=stack)
    failed = [row for row in rows if str(row["ResourceStatus"]).endswith("_FAILED")]
    reasons = [
        f"{row['LogicalResourceId']}: {row.get('ResourceStatusReason', 'no reason given')}" for row in failed
    ]
    return reasons[-1] if reasons else "AWS gives no reason"


def _write_park_note(step: Step, world: StepContext) -> None:
    """Write the sizes of the groups into the note before they are changed.

    An existing note keeps its sizes and its time; whether it is a deep one is updated.
    """
    note = read_note(world.account, world.names)
    groups = note.groups if note is not None else read_sizes(world.account, world.names)
    since = note.since if note is not None else world.now().isoformat(timespec="seconds")
    write_note(world.account, world.names, ParkNote(groups=groups, since=since, deep=step.deep))


def _silence_alarms(step: Step, world: StepContext) -> None:
    silence_alarms(world.account, world.names)


def _empty(step: Step, world: StepContext) -> None:
    for group in read_sizes(world.account, world.names):
        empty_group(world.account, group)


def _await_empty(step: Step, world: StepContext) -> None:
    deadline = world.clock() + DRAIN_S + _EMPTY_TIMEOUT_S
    while remaining := sum(group.instances for group in read_sizes(world.account, world.names).values()):
        if world.clock() > deadline:
            raise DeploymentFailed(
                f"{remaining} servers were not terminated within {DRAIN_S + _EMPTY_TIMEOUT_S:g} s",
                hint="rse-pf cloud status shows them; then repeat the command",
            )
        world.sleep(_POLL_S)


def _fill(step: Step, world: StepContext) -> None:
    scaling = world.settings.scaling
    local = world.now().astimezone(zone_named(scaling.time_zone))
    # AWS does not repeat the scheduled actions that were due while the group was parked.
    fill_groups(
        world.account, world.names, least=minimum_at(parse_schedule(scaling.schedule), local, otherwise=0)
    )


def _alert(step: Step, world: StepContext) -> None:
    enable_alarms(world.account, world.names)


def _forget(step: Step, world: StepContext) -> None:
    delete_note(world.account, world.names)


def _await_healthy(step: Step, world: StepContext) -> None:
    limit_s = GRACE_S + _HEALTHY_TIMEOUT_S
    deadline = world.clock() + limit_s
    while True:
        group = read_group(world.account, world.settings, now=world.now(), asks_robots=False)
        if group.is_healthy:
            return
        if world.clock() > deadline:
            raise DeploymentFailed(
                f"{group.wanted_servers} healthy servers are wanted, and are not there after {limit_s:g} s",
                hint="rse-pf cloud status shows which are not; docs/operations.md says what to look at",
            )
        world.sleep(_POLL_S)


def _unprotect(step: Step, world: StepContext) -> None:
    world.account.change(
        "cloudformation", "update_termination_protection",
        StackName=world.names.stack(step.box), EnableTerminationProtection=False,
    )  # fmt: skip


def _sweep(step: Step, world: StepContext) -> None:
    sweep(world.account, world.names)


def _erase(step: Step, world: StepContext) -> None:
    for refused in erase_data(world.account, world.names, audit_days=world.settings.cloud.audit_days):
        world.report_progress(refused)


_EFFECTS: dict[Action, Callable[[Step, StepContext], None]] = {
    "build": _build, "bootstrap": _bootstrap, "settle": _settle, "deploy": _deploy, "destroy": _destroy,
    "note": _write_park_note, "silence": _silence_alarms, "empty": _empty, "await-empty": _await_empty,
    "fill": _fill, "alert": _alert, "forget": _forget, "await-healthy": _await_healthy,
    "unprotect": _unprotect, "sweep": _sweep, "erase": _erase,
}  # fmt: skip
