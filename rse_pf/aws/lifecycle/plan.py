"""Decide by which steps a deployment is created or updated, parked, resumed or removed.

The plan depends only on the resources that exist; a step that was carried out before may be repeated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from rse_pf.aws.lifecycle.deployment import Deployment, GroupSize
from rse_pf.config.resource_names import STACKS
from rse_pf.errors import ConfigurationError

__all__ = ["KEPT", "Action", "Step", "plan_down", "plan_park", "plan_resume", "plan_up", "size_to_restore"]

KEPT = "Data"
"""The stack with maps, logs and the signing key; `plan_down` keeps it unless the data is deleted, too."""

Action = Literal[
    "build", "bootstrap", "settle", "deploy", "destroy", "note", "silence", "empty", "await-empty",
    "fill", "alert", "forget", "await-healthy", "unprotect", "sweep", "erase",
]  # fmt: skip

_TEXTS: dict[Action, str] = {
    "build": "build the packages",
    "bootstrap": "prepare the account for the CDK (bucket and roles, once per region)",
    "settle": "wait until AWS has finished with the stack {}",
    "deploy": "deploy the stack {}",
    "destroy": "destroy the stack {}",
    "note": "note the sizes of the groups",
    "silence": "stop alarms from acting and notifying",
    "empty": "set the size of every group to 0",
    "await-empty": "wait until the servers have drained and are terminated",
    "fill": "restore the sizes of the groups",
    "alert": "let alarms act and notify again",
    "forget": "delete the note of the sizes",
    "await-healthy": "wait until as many servers as wanted are healthy",
    "unprotect": "allow the deletion of the stack {}",
    "sweep": "delete log groups, alarms, volumes and interfaces that no stack owns",
    "erase": "delete the buckets with all versions, and the signing key, which AWS can restore for 30 days",
}


@dataclass(frozen=True, slots=True)
class Step:
    """One step of a plan.

    *box* is the short name of the stack that the step changes, such as ``Backend``, or empty; *deep* says in
    the step ``note`` that the deployment is parked deeply.
    """

    action: Action
    box: str = ""
    deep: bool = False

    def __str__(self) -> str:
        """Return a description of the step for the operator, in one line."""
        return _TEXTS[self.action].format(self.box)


def plan_up(deployment: Deployment, *, has_packages: bool) -> list[Step]:
    """Return the steps that create missing stacks, update the others, and resume a parked deployment."""
    steps = [] if has_packages else [Step("build")]
    if not deployment.is_bootstrapped:
        steps.append(Step("bootstrap"))
    for box in STACKS:
        steps += _plan_wait(deployment, box)
        steps.append(Step("deploy", box))
    if deployment.note is not None:
        steps += [Step("fill"), Step("alert"), Step("forget")]
    return [*steps, Step("await-healthy")]


def plan_park(deployment: Deployment, *, deep: bool) -> list[Step]:
    """Return the steps that drain and terminate all servers and, if *deep*, destroy all stacks but Data.

    A deployment that is parked deeply already stays so, also if *deep* is false.

    Raises:
        ConfigurationError: There is no deployment.
    """
    note = deployment.note
    if note is None and "Backend" not in deployment.stacks:
        raise ConfigurationError("there is no platform to park", hint="put it up: rse-pf cloud up")
    steps = [] if note is not None and (note.deep or not deep) else [Step("note", deep=deep)]
    if deployment.groups:
        busy = any(group.max_servers or group.instances for group in deployment.groups.values())
        if note is None or busy:
            steps += [Step("silence"), Step("empty"), Step("await-empty")]
    if deep or (note is not None and note.deep):
        steps += [*_plan_destruction(deployment), Step("sweep")]
    return steps


def plan_resume(deployment: Deployment, *, has_packages: bool) -> list[Step]:
    """Return the steps that resume a parked deployment; of a deeply parked one, those of `plan_up`.

    Raises:
        ConfigurationError: The deployment is not parked.
    """
    if deployment.note is None:
        raise ConfigurationError(
            "the platform is not parked", hint="rse-pf cloud status shows it; rse-pf cloud up puts it up"
        )
    if deployment.note.deep:
        return plan_up(deployment, has_packages=has_packages)
    return [Step("fill"), Step("alert"), Step("forget"), Step("await-healthy")]


def plan_down(deployment: Deployment, *, delete_data: bool) -> list[Step]:
    """Return the steps that destroy all stacks but `KEPT`; if *delete_data*, also `KEPT` with its data."""
    steps = list(_plan_destruction(deployment))
    if deployment.note is not None:
        steps.append(Step("forget"))
    if delete_data:
        if KEPT in deployment.stacks:
            steps += [*_plan_wait(deployment, KEPT), Step("unprotect", KEPT), Step("destroy", KEPT)]
        steps.append(Step("erase"))
    return [*steps, Step("sweep")]


def size_to_restore(saved: GroupSize | None, now: GroupSize) -> GroupSize | None:
    """Return *saved* if the group still has the size 0 of a parked group; None if it must keep its size.

    A group whose maximum is not 0 was deployed again, with newer settings, or was restored already.
    """
    return saved if saved is not None and now.max_servers == 0 else None


def _plan_destruction(deployment: Deployment) -> Iterator[Step]:
    for box in reversed(STACKS):
        if box != KEPT and box in deployment.stacks:
            yield from _plan_wait(deployment, box)
            yield Step("destroy", box)


def _plan_wait(deployment: Deployment, box: str) -> list[Step]:
    """Return a step that waits, if AWS still changes the stack because of an earlier command; else none."""
    return [Step("settle", box)] if deployment.stacks.get(box, "").endswith("_IN_PROGRESS") else []
