"""Run the platform on AWS: what a deployment lacks, what it costs, its health, and what was left behind.

examples:
  rse-pf cloud up
  rse-pf cloud park --deep
  rse-pf cloud down
  rse-pf cloud doctor
  rse-pf cloud cost --robots 20 --fps 5 --hours-per-day 8
  rse-pf cloud status
  rse-pf cloud leftovers
"""

from __future__ import annotations

import argparse
import importlib
from typing import Any

from rse_pf.config import PlatformSettings

__all__ = ["ACTIONS", "add_arguments", "run"]

ACTIONS = {
    "up": "put the platform up, bring it up to date, or finish what was begun",
    "upgrade": "replace the servers by those of the newest deployment, one by one, or return to the old ones",
    "park": "end all servers until resume; the data and the load balancer stay",
    "resume": "end parking, with as many servers as before",
    "down": "destroy the platform, and prove that nothing is left but what is kept",
    "doctor": "check tools, packages, account, certificate and quotas before a deployment",
    "cost": "what a load costs a month, line by line, on the fleet and on the Lambda",
    "status": "servers, their health, alarms, robots",
    "logs": "what a server logged, also one that is gone, and what a failed boot wrote",
    "canary": "give the canary a new key, and enrol it",
    "leftovers": "resources in the account that belong to no stack",
}
"""Action and one line of help.  Each is a module of this folder, with ``add_arguments`` and ``run``."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    for name, text in ACTIONS.items():
        _module(name).add_arguments(actions.add_parser(name, help=text, description=text))


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Run one action and return the exit code; 1 means that the operator has to act."""
    code: int = _module(args.action).run(args, settings)
    return code


def _module(action: str) -> Any:
    return importlib.import_module(f"rse_pf.cli.cloud.{action}")
