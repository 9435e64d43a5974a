"""rse-pf cloud up: put the platform up on AWS, bring it up to date, or finish what was begun."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rse_pf.aws.account import Account
from rse_pf.cli.cloud import changing
from rse_pf.cli.cloud.doctor import NO_PACKAGES, check_tools
from rse_pf.cli.doctor import Finding
from rse_pf.command_line.options import Action
from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import IDLE_HOURS, parks_when_idle
from rse_pf.terminal import show

__all__ = ["ACTION", "finish", "show_failed_checks"]


def bring_up(request: changing.ChangeRequest, settings: PlatformSettings) -> int:
    """Deploy the platform, update it, or finish a deployment that was interrupted; return 0.

    Returns 1 if a check fails, which has to be fixed first, or if the operator does not confirm.
    """
    from rse_pf.aws.account import open_account
    from rse_pf.aws.lifecycle.deployment import read_deployment
    from rse_pf.aws.lifecycle.plan import plan_up

    account = open_account(settings.cloud.region)
    tools = changing.make_tools(account, settings, request)
    plan = plan_up(read_deployment(account, settings), has_packages=tools.has_packages)
    if show_failed_checks(account, settings):
        return 1
    changing.show_steps(plan)
    changing.show_costs(
        settings,
        lambda costs: [f"it then costs {costs.line(costs.running)}, and more with robots: rse-pf cloud cost"],
    )
    if not changing.confirmed(request):
        return 1
    changing.perform(plan, changing.open_world(account, settings, tools))
    return finish(account, settings)


def show_failed_checks(account: Account, settings: PlatformSettings) -> bool:
    """Print the checks that failed and must be fixed before a deployment; return whether there is any."""
    failed = [finding for finding in _findings(account, settings) if finding.grade == "fail"]
    for finding in failed:
        show(*finding.lines())
    return bool(failed)


def finish(account: Account, settings: PlatformSettings) -> int:
    """Print the address of the deployment, and the commands that usually follow; return 0."""
    from rse_pf.aws.fleet.upgrade import versions_behind
    from rse_pf.aws.lifecycle.deployment import read_deployment

    cloud = settings.cloud
    show(f"the platform is up: {read_deployment(account, settings).url}")
    behind = versions_behind(account, settings)
    if behind is not None:
        show(f"its servers run release {behind[0]}, and {behind[1]} is new: rse-pf cloud upgrade")
    show("next: rse-pf token init --cloud             once: the key that signs tokens")
    show("      rse-pf token issue robot-1 --cloud    a robot's token")
    if cloud.canary:
        show("      rse-pf cloud canary                   once: its key, or its alarm fires")
    show("      rse-pf cloud status                   servers, robots, alarms, cost")
    show("      rse-pf cloud park                     for the night; rse-pf cloud resume in the morning")
    if parks_when_idle(settings):
        show(f"it parks itself after {IDLE_HOURS} hours without robots (cloud.idle_action)")
    return 0


def _findings(account: Account, settings: PlatformSettings) -> Iterator[Finding]:
    """Yield the results of rse-pf cloud doctor, except for those that a step of `bring_up` repairs."""
    from rse_pf.aws.lifecycle.account_checks import NOT_BOOTSTRAPPED, check_account

    for finding in check_tools(Path.cwd()):
        if not finding.what.startswith(NO_PACKAGES):
            yield finding
    for check in check_account(account, settings):
        if not check.what.startswith(NOT_BOOTSTRAPPED):
            yield Finding(grade=check.grade, what=check.what, fix=check.fix)


ACTION = Action(
    help="deploy the platform, update it, or finish a deployment that was interrupted",
    request=changing.ChangeRequest,
    run=bring_up,
)
