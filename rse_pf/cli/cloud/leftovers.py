"""rse-pf cloud leftovers: resources in the account that belong to no stack."""

from __future__ import annotations

import argparse

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.terminal import show

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare nothing: the action has no options."""


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Print what is left over; return 1 if anything is."""
    from rse_pf.aws.account import open_account
    from rse_pf.aws.money.leftovers import find_leftovers, living_stacks

    account, names = open_account(settings.cloud.region), ResourceNames(settings.cloud.name)
    stacks = living_stacks(account, names)
    if stacks:
        show(f"these stacks stand, and what they own is not listed: {', '.join(stacks)}")
    found = find_leftovers(account, names)
    for each in found:
        show(f"{each.kind}  {each.name}", f"  {each.why}", f"  remove: {each.remove}")
    unread = sum(each.unread for each in found)
    show(f"{len(found) - unread} left over" + (f", {unread} could not be looked into" if unread else ""))
    return 1 if found else 0
