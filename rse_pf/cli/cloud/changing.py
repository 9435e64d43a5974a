"""Functions of the actions up, park, resume and down: show steps and costs, ask to confirm, carry out."""

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
    """The options of an action that changes the deployment."""

    settings: Path | None = None
    yes: bool = option("--yes", help="do not ask for a confirmation")


class DeploymentCosts:
    """The costs of a deployment without robots: running, parked, and deeply parked (``deep``)."""

    def __init__(self, settings: PlatformSettings, prices: Prices) -> None:
        self.prices = prices
        self.running = bill_of(settings, prices)
        self.parked, self.deep = (parked(self.running, deep=deep) for deep in (False, True))

    def line(self, bill: Bill) -> str:
        """Return the total of *bill* as words: its price an hour and a month."""
        money = self.prices.currency
        return f"{bill.total / HOURS:.2f} {money} an hour, {bill.total:.0f} {money} a month"

    def server_per_hour(self, settings: PlatformSettings) -> float:
        """Return the price of one more backend server for an hour, in the currency of the prices."""
        return self.prices.server(settings.cloud.instance_type).per_hour

    def warnings(self, settings: PlatformSettings) -> list[str]:
        """Return the warnings about the prices, for example that they are old or of another region."""
        today = datetime.now(timezone.utc).date()
        return self.prices.warnings(today=today, region=settings.cloud.region)


def deployment_costs(settings: PlatformSettings) -> DeploymentCosts:
    """Return the costs of the deployment of *settings*, by the operator's prices in the working folder.

    Raises:
        ConfigurationError: The prices lack the type of the EC2 instances.
    """
    return DeploymentCosts(settings, operators_prices(None, Path.cwd()))


def make_tools(account: Account, settings: PlatformSettings, request: ChangeRequest) -> CdkTools:
    """Return the tools that deploy with the CDK from the working folder, a checkout; tests replace them."""
    caller = account.find("sts", "get_caller_identity") or {}
    return CdkTools(Path.cwd(), settings, str(caller.get("Account", "")), request.settings)


def open_world(account: Account, settings: PlatformSettings, tools: CdkTools) -> StepContext:
    """Return the context of steps: account, settings, tools, and the output of their progress."""
    return StepContext(
        account=account, settings=settings, tools=tools, report_progress=lambda text: show(f"  {text}")
    )


def show_steps(steps: Sequence[Step]) -> None:
    """Print *steps* as a numbered list."""
    show("this will:")
    show(*(f"  {at}. {step}" for at, step in enumerate(steps, 1)))


def confirmed(request: ChangeRequest, question: str = "go on?") -> bool:
    """Return whether the operator confirms the change, with --yes or by an answer to *question*.

    Raises:
        UsageError: Standard input is no terminal, so nobody can be asked.
    """
    if request.yes:
        return True
    if not sys.stdin.isatty():
        raise UsageError("nobody can confirm this here", hint="read the plan above, then add --yes")
    show(f"{question} [y/N]")
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def perform(steps: Sequence[Step], world: StepContext) -> None:
    """Carry out *steps* one after the other, and print each."""
    show("doing:")
    carry_out(steps, world)
