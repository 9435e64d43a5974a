"""Functions of the actions up, park, resume and down: show steps and costs, ask to confirm, carry out."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rse_pf.aws.account import Account
from rse_pf.aws.lifecycle.cdk_tools import CdkTools
from rse_pf.aws.lifecycle.execution import StepContext, carry_out
from rse_pf.aws.lifecycle.plan import Step
from rse_pf.command_line.extras import is_installed
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import show

if TYPE_CHECKING:
    from rse_pf.extensions.costs.deployment import DeploymentCosts

__all__ = [
    "ChangeRequest",
    "confirmed",
    "deployment_costs",
    "make_tools",
    "open_world",
    "perform",
    "show_costs",
    "show_steps",
]


@dataclass(frozen=True, kw_only=True)
class ChangeRequest:
    """The options of an action that changes the deployment."""

    settings: Path | None = None
    yes: bool = option("--yes", help="do not ask for a confirmation")


def deployment_costs(settings: PlatformSettings) -> DeploymentCosts | None:
    """Return the costs of the deployment of *settings*, by the operator's prices in the working folder.

    None if the extension was removed.

    Raises:
        ConfigurationError: The prices lack the type of the EC2 instances.
    """
    if not is_installed("rse_pf.extensions.costs"):
        return None
    from rse_pf.extensions.costs.deployment import DeploymentCosts
    from rse_pf.extensions.costs.prices import operators_prices

    return DeploymentCosts(settings, operators_prices(None, Path.cwd()))


def show_costs(settings: PlatformSettings, lines: Callable[[DeploymentCosts], Iterable[str]]) -> None:
    """Print *lines* about the costs of the deployment, and warnings about the prices.

    Nothing is printed if the extension was removed.
    """
    costs = deployment_costs(settings)
    if costs is not None:
        show(*lines(costs), *costs.warnings(settings))


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
