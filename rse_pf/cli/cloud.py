"""Check the platform on AWS: what a deployment lacks, what it costs, its health, and what was left behind.

It reads only; npx cdk deploy and npx cdk destroy do the rest, see docs/operations.md.

examples:
  rse-pf cloud doctor
  rse-pf cloud cost --robots 20 --fps 5 --hours-per-day 8
  rse-pf cloud status
  rse-pf cloud leftovers
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import re
import shutil
import subprocess
import sysconfig
from collections.abc import Iterator
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path

from rse_pf.cli.doctor import Finding, report
from rse_pf.config import PlatformSettings
from rse_pf.errors import MissingExtra, RsePfError, UsageError
from rse_pf.terminal import counted, show

__all__ = ["add_arguments", "check_tools", "run"]

_OLDEST_NODE = 22
_NODE_ANSWERS_S = 10.0
_CLI = Path("node_modules", "aws-cdk", "package.json")
_PINNED = Path("package.json")
_PACKAGES = Path("build")
_SCHEMA = "@aws-cdk/cloud-assembly-schema"
_MAX_ROBOTS = 1_000_000
_MAX_FPS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    made = {
        name: actions.add_parser(name, help=text, description=text)
        for name, text in {
            "doctor": "check tools, packages, account, certificate and quotas before a deployment",
            "cost": "what a load costs a month, on the fleet and on the Lambda",
            "status": "servers, their health, alarms, robots",
            "leftovers": "resources in the account that belong to no stack",
        }.items()
    }
    made["cost"].add_argument("--robots", type=int, default=10, metavar="N", help="default: %(default)s")
    made["cost"].add_argument(
        "--fps", type=float, default=5.0, metavar="F", help="frames a second of each (default: %(default)s)"
    )
    made["cost"].add_argument(
        "--hours-per-day", type=float, default=24.0, metavar="H", help="hours at work (default: %(default)s)"
    )
    made["cost"].add_argument(
        "--prices", type=Path, metavar="FILE", help="JSON file of prices to use in place of ours, all or some"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Run one action and return the exit code; 1 means that the operator has to act."""
    actions = {"doctor": _doctor, "cost": _cost, "status": _status, "leftovers": _leftovers}
    return actions[args.action](args, settings)


def _doctor(args: argparse.Namespace, settings: PlatformSettings) -> int:
    findings = itertools.chain(check_tools(Path.cwd()), _account_findings(settings))
    return report(findings, "ready: npx cdk deploy --all")


def _account_findings(settings: PlatformSettings) -> Iterator[Finding]:
    from rse_pf.aws.account import open_account
    from rse_pf.aws.money.quotas import check_account

    try:
        for check in check_account(open_account(settings.cloud.region), settings):
            yield Finding(grade=check.grade, what=check.what, fix=check.fix)
    except RsePfError as error:
        yield Finding(grade="fail", what=error.message, fix=error.hint)


def check_tools(checkout: Path) -> Iterator[Finding]:
    """Yield what a deployment from *checkout* needs on this machine; no account is asked."""
    yield _node()
    yield _cli(checkout)
    yield (
        Finding(grade="ok", what="packages are built")
        if all(any((checkout / _PACKAGES / name).glob("*")) for name in ("wheelhouse", "lambda"))
        else Finding(grade="fail", what=f"no packages in {_PACKAGES}", fix="make assets")
    )


def _node() -> Finding:
    fix = f"make setup installs Node {_OLDEST_NODE} or newer into .venv"
    path = os.pathsep.join((sysconfig.get_path("scripts"), os.environ.get("PATH", "")))
    found = shutil.which("node", path=path)
    if found is None:
        return Finding(grade="fail", what="Node is not installed", fix=fix)
    try:
        told = subprocess.run(
            [found, "--version"], capture_output=True, text=True, timeout=_NODE_ANSWERS_S, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError) as error:
        return Finding(grade="fail", what=f"Node does not run: {error}", fix=fix)
    version = re.match(r"v(\d+)\.", told)
    if version is None or int(version[1]) < _OLDEST_NODE:
        return Finding(grade="fail", what=f"Node {told} is too old for the CDK", fix=fix)
    return Finding(grade="ok", what=f"Node {told}")


def _cli(checkout: Path) -> Finding:
    """Compare the assembly that the library writes with the newest that the command line reads."""
    fix = "make setup installs the one in package-lock.json; never npm install aws-cdk"
    try:
        writes = metadata.version("aws-cdk.cloud-assembly-schema")
    except metadata.PackageNotFoundError:
        return Finding(grade="fail", what="aws-cdk-lib is not installed", fix=MissingExtra.command("infra"))
    try:
        cli = json.loads((checkout / _CLI).read_text(encoding="utf-8"))
        pinned = json.loads((checkout / _PINNED).read_text(encoding="utf-8"))["devDependencies"]["aws-cdk"]
        version, reads = str(cli["version"]), str(cli["devDependencies"][_SCHEMA])
        newest = int(re.sub(r"^\D*", "", reads).partition(".")[0])
    except (OSError, ValueError, KeyError, TypeError):
        return Finding(grade="fail", what="the CDK's command line is not installed here", fix=fix)
    line = f"CDK command line {version} reads assembly schema {newest}, the library writes {writes}"
    if newest < int(writes.partition(".")[0]):
        return Finding(grade="fail", what=line, fix=fix)
    if version != pinned:
        return Finding(grade="warn", what=f"{line}; package.json pins {pinned}", fix=fix)
    return Finding(grade="ok", what=line)


def _cost(args: argparse.Namespace, settings: PlatformSettings) -> int:
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


def _status(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.aws.account import open_account
    from rse_pf.aws.fleet.group import read_group

    account = open_account(settings.cloud.region)
    fleet = read_group(account, settings, now=datetime.now(timezone.utc))
    show(
        f"{counted(len(fleet.servers), 'server')}, wanted {fleet.wanted_servers}"
        f" of {fleet.min_servers} to {fleet.max_servers}"
    )
    for each in fleet.servers:
        health = ", ".join(each.targets) or "in no target group"
        robots = "robots: not told" if each.robots is None else counted(int(each.robots), "robot")
        show(f"  {each.name}  {each.zone}  {each.state:<12}  {health:<20}  {robots}")
    if fleet.robots:
        told = fleet.robots
        of = f" of {len(fleet.servers)}" if len(told) < len(fleet.servers) else ""
        servers = "server" if len(told) == 1 and not of else "servers"
        show(f"{sum(told):g} robots on {len(told)}{of} {servers}, {min(told):g} to {max(told):g} on each")
    else:
        show("robots: no server told how many it has")
    for name, state in sorted(fleet.alarms.items()):
        hint = f"  docs/operations.md#{name}" if state == "ALARM" else ""
        show(f"  alarm {name:<12} {state}{hint}")
    return 0 if fleet.is_healthy else 1


def _leftovers(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.aws.account import open_account
    from rse_pf.aws.money.leftovers import find_leftovers, living_stacks

    account = open_account(settings.cloud.region)
    stacks = living_stacks(account)
    if stacks:
        show(f"these stacks stand, and what they own is not listed: {', '.join(stacks)}")
    found = find_leftovers(account)
    for each in found:
        show(f"{each.kind}  {each.name}", f"  {each.why}", f"  remove: {each.remove}")
    unread = sum(each.unread for each in found)
    show(f"{len(found) - unread} left over" + (f", {unread} could not be looked into" if unread else ""))
    return 1 if found else 0
