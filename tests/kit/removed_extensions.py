"""Which commands belong to an extension, so that tests of tables leave those of a removed one out."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import pytest

from rse_pf.command_line.extras import is_installed

__all__ = ["installed_commands", "is_removed", "skip_if_removed"]

_EXPERIMENTS = "rse_pf.extensions.experiments"
_PACKAGES = {
    "batch": "rse_pf.extensions.batch",
    "camera check": "client_sdk.check",
    "check": "rse_pf.extensions.check",
    "cloud cost": "rse_pf.extensions.costs",
    "compare": _EXPERIMENTS,
    "demo": _EXPERIMENTS,
    "experiment": _EXPERIMENTS,
    "fleet": "rse_pf.extensions.fleet_page",
    "map export": "rse_pf.extensions.map_export",
    "map from-bag": "client_sdk.bags",
    "map to-bag": "client_sdk.bags",
    "replay": "rse_pf.extensions.recording",
    "rosbridge": "rse_pf.extensions.rosbridge",
    "swarm": _EXPERIMENTS,
}
"""Package that a command needs, by its verb, or its verb and action."""


def is_removed(command: str) -> bool:
    """Return whether *command*, without ``rse-pf``, needs an extension that was removed."""
    words = command.split()
    needed = [_PACKAGES.get(" ".join(words[:count])) for count in (1, 2)]
    return any(package is not None and not is_installed(package) for package in needed)


def installed_commands(commands: Sequence[str]) -> list[str]:
    """Return *commands*, which begin with ``rse-pf``, but print those that need a removed extension."""
    left_out = [command for command in commands if is_removed(command.removeprefix("rse-pf "))]
    for command in left_out:
        # The stream of the process: the `capsys` of a test would read what is written to `sys.stderr`.
        print(f"not run, because its extension was removed: {command}", file=sys.__stderr__)
    return [command for command in commands if command not in left_out]


def skip_if_removed(command: str) -> None:
    """Skip the test of *command* if the command `is_removed`."""
    if is_removed(command):
        pytest.skip("the extension was removed")
