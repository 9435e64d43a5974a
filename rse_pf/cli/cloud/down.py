"""rse-pf cloud down: destroy the platform, and prove that nothing is left but what is kept on purpose."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from datetime import datetime, timezone

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle.proof import Proof, prove
from rse_pf.cli.cloud import changing
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.terminal import counted, show

__all__ = ["ACTION"]

# Longest wait until the tagging service of AWS no longer lists resources that were deleted, in seconds.
_LISTED_LATE_S = 60.0
# Time between two readings of the resources that still exist, in seconds.
_POLL_S = 5.0


@dataclass(frozen=True, kw_only=True)
class DownRequest(changing.ChangeRequest):
    """The options of rse-pf cloud down: whether the data is deleted, too, and its confirmation."""

    delete_data: bool = option(
        "--delete-data",
        help="also delete maps, packages, logs and the signing key, as far as object lock allows",
    )
    confirm: str = option(
        "--confirm", default="", metavar="NAME", help="the name that --delete-data asks for, in a script"
    )


def take_down(request: DownRequest, settings: PlatformSettings) -> int:
    """Destroy the deployment, and print which of its resources are left over or kept on purpose.

    Returns 1 if any is left over, or if the operator does not confirm, else 0.
    """
    from rse_pf.aws.account import open_account
    from rse_pf.aws.lifecycle.deployment import read_deployment
    from rse_pf.aws.lifecycle.plan import plan_down

    account, names = open_account(settings.cloud.region), ResourceNames(settings.cloud.name)
    plan = plan_down(read_deployment(account, settings), delete_data=request.delete_data)
    changing.show_steps(plan)
    changing.show_costs(
        settings, lambda costs: [f"it cost {costs.line(costs.running)}, and more with robots"]
    )
    _show_kept(prove(account, names, now=datetime.now(timezone.utc)), settings, is_over=False)
    if not changing.confirmed(request) or (request.delete_data and not _confirmed_twice(request, names)):
        return 1
    tools = changing.make_tools(account, settings, request)
    changing.perform(plan, changing.open_world(account, settings, tools))
    proof = _last_proof(account, names)
    _show_kept(proof, settings, is_over=True)
    for name in proof.left:
        show(f"LEFT OVER  {name}")
    show(f"{len(proof.left)} left over, {counted(len(proof.kept), 'resource')} kept on purpose")
    return 1 if proof.left else 0


def _confirmed_twice(request: DownRequest, names: ResourceNames) -> bool:
    """Return whether the operator typed the name of the deployment whose data is to be deleted.

    Raises:
        UsageError: --confirm has another name, or it is not given and nobody can be asked.
    """
    if request.confirm:
        if request.confirm != names.prefix:
            raise UsageError(
                f"--confirm {request.confirm} is not the name of this deployment",
                hint=f"it is {names.prefix}",
            )
        return True
    if not sys.stdin.isatty():
        raise UsageError("nobody can confirm this a second time here", hint=f"add --confirm {names.prefix}")
    show(
        "maps and logs cannot be brought back, and the signing key only within 30 days; "
        f"type {names.prefix} to delete them"
    )
    return sys.stdin.readline().strip() == names.prefix


def _last_proof(account: Account, names: ResourceNames) -> Proof:
    """Return the resources that remain, once AWS lists none as left over or after `_LISTED_LATE_S`."""
    deadline = time.monotonic() + _LISTED_LATE_S
    while True:
        proof = prove(account, names, now=datetime.now(timezone.utc))
        if not proof.left or time.monotonic() > deadline:
            return proof
        time.sleep(_POLL_S)


def _show_kept(proof: Proof, settings: PlatformSettings, *, is_over: bool) -> None:
    """Print the resources that are kept on purpose, with size and, by the extension, monthly cost.

    *is_over* is whether the deployment is destroyed already; it only changes the words.
    """
    costs, together = changing.deployment_costs(settings), 0.0
    verb = "kept" if is_over else "there is"
    for resource in proof.kept:
        size = price = ""
        if resource.kind == "bucket":
            size = "  not measured yet" if resource.gb is None else f"  {resource.gb:.2f} GB"
        if costs is not None:
            per_month = costs.kept_per_month(resource.kind, resource.gb)
            price, together = f", {per_month:.2f} a month", together + per_month
        show(f"{verb}  {resource.kind}  {resource.name}{size}{price}")
    if proof.kept and costs is not None:
        show(f"together {together:.2f} a month")


ACTION = Action(
    help="destroy the platform, and list what is left and what is kept on purpose",
    request=DownRequest,
    run=take_down,
)
