"""rse-pf cloud resume: end parking, with as many servers as before."""

from __future__ import annotations

import argparse

from rse_pf.cli.cloud import changing, up
from rse_pf.config import PlatformSettings
from rse_pf.terminal import show

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the option of scripts."""
    changing.add_yes(parser)


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Resume the platform; return 1 if something has to be fixed first, or the operator does not agree."""
    from rse_pf.aws.account import open_account
    from rse_pf.aws.lifecycle.deployment import read_deployment
    from rse_pf.aws.lifecycle.plan import plan_resume

    account = open_account(settings.cloud.region)
    tools = changing.make_tools(account, settings, args)
    deployment = read_deployment(account, settings)
    plan = plan_resume(deployment, has_packages=tools.has_packages)
    is_deep = deployment.note is not None and deployment.note.deep
    if is_deep and up.show_failed_checks(account, settings):
        return 1
    changing.show_steps(plan)
    costs = changing.deployment_costs(settings)
    show(f"it then costs {costs.line(costs.running)}, and more with robots", *costs.warnings(settings))
    if not changing.confirmed(args):
        return 1
    changing.perform(plan, changing.open_world(account, settings, tools))
    if is_deep and not settings.cloud.allow_insecure:
        show("the load balancer has a new address: change the CNAME record of cloud.domain_name to it")
    return up.finish(account, settings)
