"""rse-pf cloud cost: what a load costs a month, line by line, on the fleet and on the Lambda."""

from __future__ import annotations

import argparse
import math
from datetime import date
from pathlib import Path

from rse_pf.aws.money.costs import Bill, Costs, Load
from rse_pf.aws.money.prices import Prices
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import counted, show

__all__ = ["add_arguments", "run"]

_MAX_ROBOTS = 1_000_000
_MAX_FPS = 1000
_MAX_BURST = 1e9


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
        "--burst", type=float, default=0.0, metavar="N",
        help="commands a day that the Lambda answers beside the fleet (default: none)",
    )  # fmt: skip
    parser.add_argument(
        "--job-hours", type=float, default=0.0, metavar="H",
        help="hours a day of all job servers together (default: none); needs cloud.job_servers",
    )  # fmt: skip
    parser.add_argument(
        "--prices", type=Path, metavar="FILE", help="JSON file of prices to use in place of ours, all or some"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Print the bill and what other ways to run the platform would cost, and return 0."""
    from rse_pf.aws.money.costs import NOT_INCLUDED, bill_of, compare
    from rse_pf.aws.money.prices import operators_prices

    load = _load(args, settings)
    prices = operators_prices(args.prices, Path.cwd())
    bill, costs = bill_of(settings, prices, load), compare(settings, prices, load)
    show(
        f"{counted(load.robots, 'robot')}, {load.fps:g} commands/s each, {load.hours_per_day:g} h a day: "
        f"{load.commands_per_s:g} commands/s of {prices.command_cpu_ms:g} ms; {settings.cloud.profile} "
        f"profile, {settings.cloud.region}",
        "",
    )
    _show_bill(bill, prices)
    _show_alternatives(bill, costs, settings, prices, load)
    show("", f"prices of {prices.as_of}, {prices.region}: {prices.source}; a month has 730 h")
    for line in prices.warnings(today=date.today(), region=settings.cloud.region):
        show(line)
    show(f"not included: {NOT_INCLUDED}")
    if settings.cloud.job_servers and not load.job_hours_per_day:
        show("without --job-hours no job server runs: each is paid while there are jobs")
    return 0


def _load(args: argparse.Namespace, settings: PlatformSettings) -> Load:
    """Return the load that the options describe; raises UsageError."""
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
    if not 0 <= args.burst <= _MAX_BURST:
        raise UsageError(
            f"--burst {args.burst:g} is not within 0..{_MAX_BURST:g}",
            hint="name commands a day, such as 5000",
        )
    most = 24 * settings.cloud.job_servers
    if args.job_hours > 0 == most:
        raise UsageError(
            f"--job-hours {args.job_hours:g}, but there are no job servers: cloud.job_servers is 0",
            hint="leave the option out, or set cloud.job_servers in cdk.json",
        )
    if not 0 <= args.job_hours <= most:
        raise UsageError(
            f"--job-hours {args.job_hours:g} is not within 0..{most}: "
            f"cloud.job_servers is {settings.cloud.job_servers}, and a day has 24 hours",
            hint="name fewer hours, or set more cloud.job_servers in cdk.json",
        )
    return Load(
        robots=args.robots, fps=args.fps, hours_per_day=args.hours_per_day,
        burst_commands_per_day=args.burst, job_hours_per_day=args.job_hours,
    )  # fmt: skip


def _show_bill(bill: Bill, prices: Prices) -> None:
    show(
        f"{'box of Fig. 2':<17}{'what':<47}{'units':>10} {'':<8}{'each':>10}{prices.currency + '/month':>11}"
    )
    for box, amount in bill.sum_by_box().items():
        for line in bill.lines:
            if line.box == box:
                show(
                    f"{box:<17}{line.what:<47}{line.count:>10,.1f} {line.unit:<8}{line.price:>10.4g}"
                    f"{line.amount:>11.2f}"
                )
        show(f"{'':<17}{'= ' + box:<76}{amount:>11.2f}")
    show(f"{'total':<93}{bill.total:>11.2f}")


def _show_alternatives(
    bill: Bill, costs: Costs, settings: PlatformSettings, prices: Prices, load: Load
) -> None:
    from rse_pf.aws.money.costs import bill_of, parked, parked_at_night

    most, executions = settings.scaling.max_servers, settings.cloud.lambda_concurrency
    spot = settings.replace(cloud={"spot": True, "warm_servers": 0})
    rows = [
        ("a robot for an hour", f"{bill.total / load.robot_hours:.4f}"),
        ("without any robot", f"{costs.floor:.2f}"),
        ("with cloud.spot", f"{bill_of(spot, prices, load).total:.2f}"),
        ("parked all month", f"{parked(bill, deep=False).total:.2f}"),
        ("parked all month, --deep", f"{parked(bill, deep=True).total:.2f}"),
        ("on the Lambda alone", f"{costs.serverless:.2f}"),
    ]
    if load.hours_per_day < 24:
        rows[3:3] = [
            ("parked outside of the hours", f"{parked_at_night(bill, load, deep=False).total:.2f}"),
            ("parked outside of the hours, --deep", f"{parked_at_night(bill, load, deep=True).total:.2f}"),
        ]
    show("")
    for name, amount in rows:
        show(f"{name:<40}{amount:>10} {prices.currency}")
    rate = costs.crossing_commands_per_s
    show(
        "",
        f"the fleet needs {counted(costs.servers, 'server')} of at most {most}, the Lambda "
        f"{costs.executions:.1f} executions of at most {executions}",
        f"the fleet is cheaper from {rate:.1f} commands/s, "
        f"{counted(math.ceil(rate / load.fps), 'such robot')}"
        if rate is not None
        else f"the Lambda is cheaper up to {counted(most, 'server')}",
    )
    if costs.servers > most or costs.executions > executions:
        show("more than scaling.max_servers or cloud.lambda_concurrency allows: robots would be refused")
