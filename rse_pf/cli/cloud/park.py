"""rse-pf cloud park: end all servers until resume; the data stays, and the load balancer unless --deep."""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.cli.cloud import changing
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.terminal import show

__all__ = ["ACTION"]


@dataclass(frozen=True, kw_only=True)
class ParkRequest(changing.ChangeRequest):
    """The options of rse-pf cloud park: whether the load balancer is destroyed, too."""

    deep: bool = option(
        "--deep",
        help="also destroy the load balancer, the endpoints and the Lambda; the address then changes",
    )


def park(request: ParkRequest, settings: PlatformSettings) -> int:
    """Terminate all servers until resume, with --deep also balancer, endpoints and Lambda; return 0.

    Returns 1 if the operator does not confirm.
    """
    from rse_pf.aws.account import open_account
    from rse_pf.aws.lifecycle.deployment import read_deployment
    from rse_pf.aws.lifecycle.plan import plan_park

    account = open_account(settings.cloud.region)
    plan = plan_park(read_deployment(account, settings), deep=request.deep)
    if not plan:
        show("the platform is parked; rse-pf cloud resume ends that")
        return 0
    changing.show_steps(plan)
    here = {False: "<- this", True: ""}
    changing.show_costs(
        settings,
        lambda costs: [
            f"up costs             {costs.line(costs.running)}",
            f"parked costs         {costs.line(costs.parked)}; back in about 2 minutes  {here[request.deep]}",
            f"parked --deep costs  {costs.line(costs.deep)}; back in about 10 minutes  "
            f"{here[not request.deep]}",
            "stored maps and logs are not in these prices",
        ],
    )
    if settings.scaling.schedule.strip() and not request.deep:
        show("the next entry of scaling.schedule that does not lower the minimum resumes it")
    if not changing.confirmed(request):
        return 1
    tools = changing.make_tools(account, settings, request)
    changing.perform(plan, changing.open_world(account, settings, tools))
    show("the platform is parked; rse-pf cloud resume ends that")
    return 0


ACTION = Action(
    help="stop all servers until resume; the data and the load balancer stay", request=ParkRequest, run=park
)
