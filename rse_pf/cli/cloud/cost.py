"""rse-pf cloud cost: what a load costs a month, on the fleet and on the Lambda."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import counted, show

__all__ = ["add_arguments", "run"]

_MAX_ROBOTS = 1_000_000
_MAX_FPS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the load, and the file of prices."""
    parser.add_argument("--robots", type=int, default=10, metavar="N", help="default: %(default)s")
    parser.add_argument(
        "--fps", type=float, default=5.0, metavar="F", help="frames a second of each (default: %(default)s)"
    )
    parser.add_argument(
        "--hours-per-day", type=float, default=24.0, metavar="H", help="hours at work (default: %(default)s)"
    )
    parser.add_argument(
        "--prices", type=Path, metavar="FILE", help="JSON file of prices to use in place of ours, all or some"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Print the table of costs and return 0."""
    from rse_pf.aws.money.costs import HOURS, NOT_INCLUDED, Load, compare
    from rse_pf.aws.money.prices import load_prices

    if not 1 <= args.robots <= _MAX_ROBOTS:
        raise UsageError(
            f"--robots {args.robots} is not within 1..{_MAX_ROBOTS}", hint="name how many robots there are"
        )
    if not (math.isfinite(args.fps) and 0 < args.fps <= _MAX_FPS):
        raise UsageError(
            f"--fps {args.fps:g} is not within 0..{_MAX_FPS}", hint="name frames per second, such as 5"
        )
    if not 0 < args.hours_per_day <= 24:
        raise UsageError(
            f"--hours-per-day {args.hours_per_day:g} is not within 0..24", hint="24 is all day and night"
        )
    load = Load(robots=args.robots, fps=args.fps, hours_per_day=args.hours_per_day)
    prices, cloud = load_prices(args.prices), settings.cloud
    costs = compare(settings, prices, load)
    most, executions = settings.scaling.max_servers, cloud.lambda_concurrency
    rows = [
        (f"{prices.currency} a month", "EC2 fleet", "Lambda"),
        ("idle", f"{costs.floor:.2f}", "0.00"),
        ("this load", f"{costs.fleet:.2f}", f"{costs.serverless:.2f}"),
        ("needs", counted(costs.servers, "server"), f"{costs.executions:.1f} executions"),
        ("may have", counted(most, "server"), f"{executions} executions"),
    ]
    show(
        f"{counted(load.robots, 'robot')}, {load.fps:g} commands/s each, {load.hours_per_day:g} h a day: "
        f"{load.commands_per_s:g} commands/s of {prices.command_cpu_ms:g} ms",
        "",
    )
    for name, fleet, function in rows:
        show(f"{name:<12}{fleet:>14}{function:>16}")
    rate = costs.crossing_commands_per_s
    show(
        "",
        f"the fleet is cheaper from {rate:.1f} commands/s, "
        f"{counted(math.ceil(rate / load.fps), 'such robot')}"
        if rate is not None
        else f"the Lambda is cheaper up to {counted(most, 'server')}",
    )
    if costs.servers > most or costs.executions > executions:
        show("more than scaling.max_servers or cloud.lambda_concurrency allows: robots would be refused")
    show("", f"prices of {prices.as_of}, {prices.region}: {prices.source}; a month has {HOURS:g} h")
    for what, of, wanted in (
        ("cloud.region", prices.region, cloud.region),
        ("cloud.instance_type", prices.instance_type, cloud.instance_type),
    ):
        if of != wanted:
            show(f"WRONG PRICES: they are for {of}, and {what} is {wanted}: give yours with --prices")
    show(f"not included: {NOT_INCLUDED}")
    return 0
