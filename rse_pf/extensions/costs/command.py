"""rse-pf cloud cost: what a load costs a month, line by line, on the fleet and on the Lambda."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.costs.bill import Bill, Load
from rse_pf.extensions.costs.prices import Prices
from rse_pf.terminal import counted, show

__all__ = ["ACTION"]

# Largest value of --robots; larger ones are typing errors.
_MAX_ROBOTS = 1_000_000
# Largest value of --fps, in frames per second of a robot; larger ones are typing errors.
_MAX_FPS = 1000
# Largest value of --burst, in commands a day; larger ones are typing errors.
_MAX_BURST = 1e9


@dataclass(frozen=True, kw_only=True)
class CostRequest:
    """The options of rse-pf cloud cost: a load, and the prices by which it is charged."""

    robots: int = option("--robots", default=10, metavar="N", help="number of robots (default: %(default)s)")
    fps: float = option(
        "--fps", default=5.0, metavar="F", help="frames per second of each robot (default: %(default)s)"
    )
    hours_per_day: float = option(
        "--hours-per-day", default=24.0, metavar="H", help="hours at work (default: %(default)s)"
    )
    burst: float = option(
        "--burst",
        default=0.0,
        metavar="N",
        help="commands a day that the Lambda answers in addition to the fleet (default: none)",
    )
    prices: Path | None = option(
        "--prices", metavar="FILE", help="JSON file of prices that replace all or some of ours"
    )


def show_costs(request: CostRequest, settings: PlatformSettings) -> int:
    """Print the monthly bill of a load, and the costs of other ways to run the platform; return 0."""
    from rse_pf.extensions.costs.bill import NOT_INCLUDED, bill_of
    from rse_pf.extensions.costs.prices import operators_prices

    load = _load(request)
    prices = operators_prices(request.prices, Path.cwd())
    bill = bill_of(settings, prices, load)
    show(
        f"{counted(load.robots, 'robot')}, {load.fps:g} commands/s each, {load.hours_per_day:g} h a day: "
        f"{load.commands_per_s:g} commands/s of {prices.command_cpu_ms:g} ms; {settings.cloud.profile} "
        f"profile, {settings.cloud.region}",
        "",
    )
    _show_bill(bill, prices)
    _show_alternatives(bill, settings, prices, load)
    show("", f"prices of {prices.as_of}, {prices.region}: {prices.source}; a month has 730 h")
    for line in prices.warnings(today=date.today(), region=settings.cloud.region):
        show(line)
    show(f"not included: {NOT_INCLUDED}")
    return 0


def _load(request: CostRequest) -> Load:
    """Return the load that the options describe; raises UsageError for a value out of bounds."""
    if not 1 <= request.robots <= _MAX_ROBOTS:
        raise UsageError(
            f"--robots {request.robots} is not within 1..{_MAX_ROBOTS}", hint="name how many robots there are"
        )
    if not (math.isfinite(request.fps) and 0 < request.fps <= _MAX_FPS):
        raise UsageError(
            f"--fps {request.fps:g} is not within 0..{_MAX_FPS}", hint="name frames per second, such as 5"
        )
    if not 0 < request.hours_per_day <= 24:
        raise UsageError(
            f"--hours-per-day {request.hours_per_day:g} is not within 0..24", hint="24 is all day and night"
        )
    if not 0 <= request.burst <= _MAX_BURST:
        raise UsageError(
            f"--burst {request.burst:g} is not within 0..{_MAX_BURST:g}",
            hint="name commands a day, such as 5000",
        )
    return Load(
        robots=request.robots,
        fps=request.fps,
        hours_per_day=request.hours_per_day,
        burst_commands_per_day=request.burst,
    )


def _show_bill(bill: Bill, prices: Prices) -> None:
    """Print the lines of *bill* by box of Fig. 2, with the sum of each box and the total."""
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


def _show_alternatives(bill: Bill, settings: PlatformSettings, prices: Prices, load: Load) -> None:
    """Print what other ways to run the platform cost, and whether the settings allow this load."""
    from rse_pf.extensions.costs.bill import (
        DAY_H,
        bill_of,
        lambda_alone,
        lambda_executions,
        parked,
        servers_needed,
    )

    spot = settings.replace(cloud={"spot": True, "warm_servers": 0})
    without_robots = bill_of(settings, prices, replace(load, robots=0))
    shallow, deep = (parked(without_robots, deep=deep).total for deep in (False, True))
    at_work = bill_of(settings, prices, replace(load, hours_per_day=DAY_H)).total
    share = load.hours_per_day / DAY_H
    rows = {
        "a robot for an hour": f"{bill.total / (load.robots * load.hours):.4f}",
        "without any robot": f"{bill_of(settings, prices).total:.2f}",
        "with cloud.spot": f"{bill_of(spot, prices, load).total:.2f}",
        "parked outside of the hours": f"{share * at_work + (1 - share) * shallow:.2f}",
        "parked outside of the hours, --deep": f"{share * at_work + (1 - share) * deep:.2f}",
        "parked all month": f"{shallow:.2f}",
        "parked all month, --deep": f"{deep:.2f}",
        "on the Lambda alone": f"{lambda_alone(prices, load):.2f}",
    }
    show("")
    for name, amount in rows.items():
        show(f"{name:<40}{amount:>10} {prices.currency}")
    servers, most = servers_needed(settings, prices, load), settings.scaling.max_servers
    executions, concurrency = lambda_executions(prices, load), settings.cloud.lambda_concurrency
    show(
        "",
        f"the fleet needs {counted(servers, 'server')} of at most {most}, the Lambda alone {executions:.1f} "
        f"executions of at most {concurrency}",
    )
    if servers > most:
        show("the fleet needs more than scaling.max_servers: robots would be refused")
    if executions > concurrency:
        show("the Lambda alone needs more than cloud.lambda_concurrency: robots would be refused")


ACTION = Action(
    help="show what a load costs a month, on the fleet and on the Lambda",
    request=CostRequest,
    run=show_costs,
)
