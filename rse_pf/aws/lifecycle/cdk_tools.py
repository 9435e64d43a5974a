"""Build and deploy: run `scripts/assets.py`, and the CDK's command line, pinned, by `scripts/cdk.sh`.

Both scripts belong to a checkout of the repository, not to the installed package.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import SETTINGS_CONTEXT, toolkit_stack
from rse_pf.errors import DeploymentFailed, UsageError

__all__ = ["PACKAGES", "CdkTools", "are_packages_built"]

PACKAGES = Path("build")
"""Folder of a checkout into which `scripts/assets.py` writes the packages of servers and functions."""


def are_packages_built(checkout: Path) -> bool:
    """Return whether the packages exist in *checkout*; whether they are up to date is checked by `stacks`."""
    return all(any((checkout / PACKAGES / name).glob("*")) for name in ("servers", "lambda"))


class CdkTools:
    """Runs the scripts of the checkout in the folder *checkout*; their output goes to the terminal.

    *settings_file* holds the settings of the deployment; None means the checkout's cdk.json.
    """

    def __init__(
        self, checkout: Path, settings: PlatformSettings, account_id: str, settings_file: Path | None = None
    ) -> None:
        self._checkout = checkout
        self._settings_file = settings_file
        self._cloud = settings.cloud
        self._account_id = account_id

    @property
    def has_packages(self) -> bool:
        """Whether the packages exist in the checkout."""
        return are_packages_built(self._checkout)

    def build(self) -> None:
        """Build the packages of servers and functions; raises DeploymentFailed if the build fails."""
        self._run("the build of the packages", [sys.executable, "scripts/assets.py"])

    def bootstrap(self) -> None:
        """Deploy the CDK's bootstrap stack with our qualifier in the region; raises DeploymentFailed."""
        where = f"aws://{self._account_id}/{self._cloud.region}"
        qualifier = self._cloud.bootstrap_qualifier
        options = ["--qualifier", qualifier, "--toolkit-stack-name", toolkit_stack(qualifier)]
        self._cdk("the bootstrap", ["bootstrap", where, *options])

    def deploy(self, stack: str) -> None:
        """Deploy one stack, without the stacks on which it depends; raises DeploymentFailed."""
        options = ["--exclusively", "--require-approval", "never", "--progress", "events"]
        self._cdk(f"the deployment of {stack}", ["deploy", stack, *options])

    def _cdk(self, task: str, words: Sequence[str]) -> None:
        file = self._settings_file
        context = [] if file is None else ["--context", f"{SETTINGS_CONTEXT}={file.resolve()}"]
        self._run(task, ["sh", "scripts/cdk.sh", *words, *context])

    def _run(self, task: str, command: Sequence[str]) -> None:
        script = next(word for word in command if word.startswith("scripts/"))
        if not (self._checkout / script).exists():
            raise UsageError(
                f"there is no {script} in {self._checkout}",
                hint="call it in the folder of a checkout of RSE-PF",
            )
        code = subprocess.run(command, cwd=self._checkout, check=False).returncode
        if code:
            raise DeploymentFailed(
                f"{task} failed with exit code {code}",
                hint="read the lines above; when the cause is gone, the same command continues",
            )
