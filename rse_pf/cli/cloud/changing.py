"""What up, park, resume and down share: they show the steps and the price, ask, carry out, and report."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle.cdk_tools import CdkTools
from rse_pf.aws.lifecycle.execution import StepContext, carry_out
from rse_pf.aws.lifecycle.plan import Step
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.costs.bill import HOURS, Bill, bill_of, parked
from rse_pf.extensions.costs.prices import Prices, operators_prices
from rse_pf.terminal import show

__all__ = [
    "ChangeRequest",
    "DeploymentCosts",
    "confirmed",
    "deployment_costs",
    "make_tools",
    "open_world",
    "perform",
    "show_steps",
]


@dataclass(frozen=True, kw_only=True)
class ChangeRequest:
    """A change of the deployment, and whether it needs no confirmation."""

    settings: Path | None = None
    yes: bool = option("--yes", help="do not ask for a confirmation")


class DeploymentCosts:
    """What a deployment costs while no robot drives: running, parked, and deeply parked."""

    def __init__(self, settings: PlatformSettings, prices: Prices) -> None:
        self.prices = prices
        self.running = bill_of(settings, prices)
        self.parked, self.deep = (parked(self.running, deep=deep) for deep in (False, True))

    def line(self, bill: Bill) -> str:
        """Return the price of *bill* an hour and a month."""
        money = self.prices.currency
        return f"{bill.total / HOURS:.2f} {money} an hour, {bill.total:.0f} {money} a month"

    def server_per_hour(self, settings: PlatformSettings) -> float:
        """Return the price of one more server."""
        return self.prices.server(settings.cloud.instance_type).per_hour

    def warnings(self, settings: PlatformSettings) -> list[str]:
        """Return what is wrong with the prices."""
        today = datetime.now(timezone.utc).date()
        return self.prices.warnings(today=today, region=settings.cloud.region)


def deployment_costs(settings: PlatformSettings) -> DeploymentCosts:
    """Return the costs by the operator's prices; raises ConfigurationError for an unknown EC2 type."""
    return DeploymentCosts(settings, operators_prices(None, Path.cwd()))


def make_tools(account: Account, settings: PlatformSettings, request: ChangeRequest) -> CdkTools:
    """Return the tools of the checkout in the working folder; tests put others in their place."""
    caller = account.find("sts", "get_caller_identity") or {}
    return CdkTools(Path.cwd(), settings, str(caller.get("Account", "")), request.settings)


def open_world(account: Account, settings: PlatformSettings, tools: CdkTools) -> StepContext:
    """Return what steps act on."""
    return StepContext(account=account, settings=settings, tools=tools, tell=lambda text: show(f"  {text}"))


def show_steps(steps: Sequence[Step]) -> None:
    """Show what will be done."""
    show("this will:")
    show(*(f"  {at}. {step}" for at, step in enumerate(steps, 1)))


def confirmed(request: ChangeRequest, question: str = "go on?") -> bool:
    """Return whether the operator agrees; raises UsageError where nobody can be asked."""
    if request.yes:
        return True
    if not sys.stdin.isatty():
        raise UsageError("nobody can confirm this here", hint="read the plan above, then add --yes")
    show(f"{question} [y/N]")
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def perform(steps: Sequence[Step], world: StepContext) -> None:
    """Carry out *steps*, and show each."""
    show("doing:")
    carry_out(steps, world)
