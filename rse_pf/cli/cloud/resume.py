"""rse-pf cloud resume: end parking, with as many servers as before."""

from __future__ import annotations

from rse_pf.cli.cloud import changing, up
from rse_pf.command_line.options import Action
from rse_pf.config import PlatformSettings
from rse_pf.terminal import show

__all__ = ["ACTION"]


def resume(request: changing.ChangeRequest, settings: PlatformSettings) -> int:
    """End the parking of the platform, and print its address; return 0.

    Returns 1 if a check fails, which has to be fixed first, or if the operator does not confirm.
    """
    from rse_pf.aws.account import open_account
    from rse_pf.aws.lifecycle.deployment import read_deployment
    from rse_pf.aws.lifecycle.plan import plan_resume

    account = open_account(settings.cloud.region)
    tools = changing.make_tools(account, settings, request)
    deployment = read_deployment(account, settings)
    plan = plan_resume(deployment, has_packages=tools.has_packages)
    is_deep = deployment.note is not None and deployment.note.deep
    if is_deep and up.show_failed_checks(account, settings):
        return 1
    changing.show_steps(plan)
    changing.show_costs(
        settings, lambda costs: [f"it then costs {costs.line(costs.running)}, and more with robots"]
    )
    if not changing.confirmed(request):
        return 1
    changing.perform(plan, changing.open_world(account, settings, tools))
    if is_deep and not settings.cloud.allow_insecure:
        show("the load balancer has a new address: change the CNAME record of cloud.domain_name to it")
    return up.finish(account, settings)


ACTION = Action(
    help="end parking, with as many servers as before", request=changing.ChangeRequest, run=resume
)
