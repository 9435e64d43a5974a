"""rse-pf cloud status: stage and cost of the deployment, its servers, their health, alarms, robots."""

from __future__ import annotations

from datetime import datetime, timezone

from rse_pf.aws.lifecycle.deployment import Deployment
from rse_pf.cli.cloud import changing
from rse_pf.command_line.options import Action, NoOptions
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.terminal import counted, show

__all__ = ["ACTION"]


def show_status(request: NoOptions, settings: PlatformSettings) -> int:
    """Print stage, costs, servers, robots and alarms of the deployment.

    Returns 1 if the fleet is not healthy; 0 if it is, or if there is none: absent or deeply parked.
    """
    from rse_pf.aws.account import open_account
    from rse_pf.aws.fleet.group import read_group
    from rse_pf.aws.lifecycle.deployment import read_deployment

    account = open_account(settings.cloud.region)
    deployment = read_deployment(account, settings)
    _show_stage(deployment, settings)
    if deployment.stage in ("absent", "deeply parked"):
        return 0
    fleet = read_group(account, settings, now=datetime.now(timezone.utc))
    show(
        f"{counted(len(fleet.servers), 'server')}, wanted {fleet.wanted_servers}"
        f" of {fleet.min_servers} to {fleet.max_servers}"
    )
    for server in fleet.servers:
        health = ", ".join(server.targets) or "in no target group"
        robots = "robots: not reported" if server.robots is None else counted(int(server.robots), "robot")
        show(f"  {server.name}  {server.zone}  {server.state:<12}  {health:<20}  {robots}")
    if fleet.robots:
        reported = fleet.robots
        of = f" of {len(fleet.servers)}" if len(reported) < len(fleet.servers) else ""
        servers = "server" if len(reported) == 1 and not of else "servers"
        show(
            f"{sum(reported):g} robots on {len(reported)}{of} {servers}, "
            f"{min(reported):g} to {max(reported):g} on each"
        )
    else:
        show("robots: no server has reported its number")
    for name, state in sorted(fleet.alarms.items()):
        hint = f"  docs/operations.md#{name}" if state == "ALARM" else ""
        show(f"  alarm {name:<12} {state}{hint}")
    return 0 if fleet.is_healthy else 1


def _show_stage(deployment: Deployment, settings: PlatformSettings) -> None:
    """Print the stage of the deployment, its costs an hour without robots, and its address if it has one."""
    note = deployment.note
    name = ResourceNames(settings.cloud.name).prefix
    parked_by = f", by the {note.by} since {note.since}: rse-pf cloud resume" if note is not None else ""
    show(f"{name} in {settings.cloud.region}: {deployment.stage}{parked_by}")
    costs = changing.deployment_costs(settings)
    if costs is not None:
        servers = sum(group.instances for group in deployment.groups.values())
        show(costs.line_now(settings, deployment.stage, servers))
    if deployment.url and note is None:
        show(deployment.url)


ACTION = Action(help="show servers, their health, alarms and robots", request=NoOptions, run=show_status)
