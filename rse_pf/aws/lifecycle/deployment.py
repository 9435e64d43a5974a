"""Read the state of a deployment: its stacks, its Auto Scaling groups, and whether it is parked.

Nothing is changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from rse_pf.aws.account import Account
from rse_pf.aws.cloudformation import list_living_stacks, read_bootstrap_version
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import DEPLOYMENT_TAG, STACKS, ResourceNames
from rse_pf.errors import ConfigurationError

__all__ = ["Deployment", "GroupSize", "ParkNote", "read_deployment", "read_note", "read_sizes"]


class GroupSize(msgspec.Struct, frozen=True, kw_only=True):
    """Minimum, wanted and maximum size of an Auto Scaling group; ``instances`` counts those in any state."""

    min_servers: int
    wanted_servers: int
    max_servers: int
    instances: int = 0


class ParkNote(msgspec.Struct, frozen=True, kw_only=True):
    """The note that a deployment is parked, with the sizes to restore; an SSM parameter holds it as JSON."""

    groups: dict[str, GroupSize]
    """Size of each Auto Scaling group before it was parked, by the group's name."""
    since: str
    """Time at which it was parked, UTC, ISO 8601."""
    by: str = "operator"
    """Who parked it: ``operator`` or ``timer`` (the idle timer)."""
    deep: bool = False
    """Whether all stacks but Data were destroyed, too, with the load balancer and the endpoints."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Deployment:
    """The state of a deployment.

    Attributes:
        stacks: CloudFormation's status of each existing stack, by its short name such as ``Backend``.
        groups: Size of each Auto Scaling group, by name.
        note: The note of a parked deployment; None if it is not parked.
        is_bootstrapped: Whether the CDK is bootstrapped in the region.
        url: Address for robots; empty if the backend stack does not exist.
    """

    stacks: Mapping[str, str] = field(default_factory=dict)
    groups: Mapping[str, GroupSize] = field(default_factory=dict)
    note: ParkNote | None = None
    is_bootstrapped: bool = False
    url: str = ""

    @property
    def stage(self) -> str:
        """Return ``parked`` or ``deeply parked`` if there is a note.

        Else return ``absent`` if no stack but Data exists, ``up`` if all stacks are complete, or
        ``incomplete``.
        """
        if self.note is not None:
            return "deeply parked" if self.note.deep else "parked"
        if not set(self.stacks) - {"Data"}:
            return "absent"
        complete = all(self.stacks.get(box, "").endswith("_COMPLETE") for box in STACKS)
        return "up" if complete else "incomplete"


def read_deployment(account: Account, settings: PlatformSettings) -> Deployment:
    """Return the state of the deployment with the name ``cloud.name``.

    Raises:
        ConfigurationError: AWS refused.
        StoreError: AWS does not answer.
    """
    names = ResourceNames(settings.cloud.name)
    stacks = list_living_stacks(account, names)
    ours = {name.removeprefix(names.stack_prefix): row for name, row in stacks.items()}
    outputs = ours.get("Backend", {}).get("Outputs", ())
    return Deployment(
        stacks={box: str(ours[box]["StackStatus"]) for box in STACKS if box in ours},
        groups=read_sizes(account, names),
        note=read_note(account, names),
        is_bootstrapped=read_bootstrap_version(account, settings) is not None,
        url=next((str(output["OutputValue"]) for output in outputs if output["OutputKey"] == "Url"), ""),
    )


def read_sizes(account: Account, names: ResourceNames) -> dict[str, GroupSize]:
    """Return the sizes of the Auto Scaling groups with the deployment's tag, by the groups' names.

    Raises the errors of `read_deployment`.
    """
    rows = account.pages(
        "autoscaling", "describe_auto_scaling_groups", "AutoScalingGroups",
        Filters=[{"Name": f"tag:{DEPLOYMENT_TAG}", "Values": [names.prefix]}],
    )  # fmt: skip
    return {str(row["AutoScalingGroupName"]): _size(row) for row in rows}


def read_note(account: Account, names: ResourceNames) -> ParkNote | None:
    """Return the note of a parked deployment; None if it is not parked.

    Raises the errors of `read_deployment`.
    """
    parameter = account.find("ssm", "get_parameter", Name=names.parked)
    if parameter is None:
        return None
    try:
        return msgspec.json.decode(parameter["Parameter"]["Value"], type=ParkNote)
    except msgspec.DecodeError as error:
        raise ConfigurationError(
            f"the SSM parameter {names.parked} cannot be read: {error}",
            hint=f"delete it: aws ssm delete-parameter --name {names.parked}; then rse-pf cloud up",
        ) from error


def _size(row: Mapping[str, Any]) -> GroupSize:
    return GroupSize(
        min_servers=row["MinSize"], wanted_servers=row["DesiredCapacity"], max_servers=row["MaxSize"],
        instances=len(row["Instances"]),
    )  # fmt: skip
