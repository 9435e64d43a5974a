"""rse-pf cloud park: end all servers until resume; the data stays, and the load balancer unless --deep."""

from __future__ import annotations

import argparse

from rse_pf.cli.cloud import changing
from rse_pf.config import PlatformSettings
from rse_pf.terminal import show

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the depth, and the option of scripts."""
    parser.add_argument(
        "--deep", action="store_true",
        help="destroy the load balancer, the endpoints and the Lambda, too; its address changes",
    )  # fmt: skip
    changing.add_yes(parser)


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Park the platform; return 1 if the operator does not agree."""
    from rse_pf.aws.account import open_account
    from rse_pf.aws.lifecycle.deployment import read_deployment
    from rse_pf.aws.lifecycle.plan import plan_park

    account = open_account(settings.cloud.region)
    plan = plan_park(read_deployment(account, settings), deep=args.deep)
    if not plan:
        show("the platform is parked; rse-pf cloud resume ends that")
        return 0
    changing.show_steps(plan)
    costs = changing.deployment_costs(settings)
    here = {False: "<- this", True: ""}
    show(f"up costs             {costs.line(costs.running)}")
    show(f"parked costs         {costs.line(costs.parked)}; back in about 2 minutes  {here[args.deep]}")
    show(f"parked --deep costs  {costs.line(costs.deep)}; back in about 10 minutes  {here[not args.deep]}")
    show("stored maps and logs are not in these prices", *costs.warnings(settings))
    if settings.scaling.schedule.strip() and not args.deep:
        show("the next entry of scaling.schedule that does not lower the minimum resumes it")
    if not changing.confirmed(args):
        return 1
    tools = changing.make_tools(account, settings, args)
    changing.perform(plan, changing.open_world(account, settings, tools))
    show("the platform is parked; rse-pf cloud resume ends that")
    return 0
