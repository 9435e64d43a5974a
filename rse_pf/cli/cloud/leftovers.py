"""rse-pf cloud leftovers: resources in the account that belong to no stack."""

from __future__ import annotations

from rse_pf.command_line.options import Action, NoOptions
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import StoreError
from rse_pf.terminal import show, show_error

__all__ = ["ACTION"]

# Exit code if AWS could not be asked; 1 means that there are leftovers.
_FAILED = 2


def show_leftovers(request: NoOptions, settings: PlatformSettings) -> int:
    """Print each resource that belongs to no stack, and how to remove it.

    Returns 1 if there is any, 2 if AWS could not be asked, else 0.
    """
    from rse_pf.aws.account import open_account
    from rse_pf.aws.cloudformation import list_living_stacks
    from rse_pf.aws.lifecycle.leftovers import find_leftovers

    account, names = open_account(settings.cloud.region), ResourceNames(settings.cloud.name)
    try:
        stacks, leftovers = list_living_stacks(account, names), find_leftovers(account, names)
    except StoreError as error:  # `main` would exit with 1, which means leftovers here
        show_error(error)
        return _FAILED
    if stacks:
        show(f"these stacks exist, and their resources are not listed: {', '.join(stacks)}")
    for leftover in leftovers:
        show(f"{leftover.kind}  {leftover.name}", f"  {leftover.why}", f"  remove: {leftover.remove}")
    unread = sum(leftover.unread for leftover in leftovers)
    show(f"{len(leftovers) - unread} left over" + (f", {unread} could not be read" if unread else ""))
    return 1 if leftovers else 0


ACTION = Action(
    help="list the resources in the account that belong to no stack", request=NoOptions, run=show_leftovers
)
