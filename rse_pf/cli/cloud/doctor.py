"""rse-pf cloud doctor: check tools, packages, account, certificate and quotas before a deployment."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import subprocess
import sysconfig
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from rse_pf.aws.lifecycle.cdk_tools import PACKAGES, are_packages_built
from rse_pf.cli.doctor import Finding, report
from rse_pf.command_line.options import Action, NoOptions
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError

__all__ = ["ACTION", "NO_PACKAGES", "check_tools"]

NO_PACKAGES = "no packages"
"""Beginning of the finding that packages are not built; `rse-pf cloud up` ignores it and builds them."""
# Oldest major version of Node with which the CDK works.
_OLDEST_NODE = 22
# Time limit of ``node --version``, in seconds.
_NODE_TIMEOUT_S = 10.0
# File of the installed command line of the CDK, in the checkout.
_CLI = Path("node_modules", "aws-cdk", "package.json")
# File of the checkout that pins the version of the CDK's command line.
_PINNED = Path("package.json")
# npm package whose version is that of the assembly (the CDK's output) that the CDK's command line can read.
_SCHEMA = "@aws-cdk/cloud-assembly-schema"


def check_deployment(request: NoOptions, settings: PlatformSettings) -> int:
    """Check tools and account and print each result; return 1 if any failed, else 0."""
    findings = itertools.chain(check_tools(Path.cwd()), _account_findings(settings))
    return report(findings, "ready: rse-pf cloud up")


def _account_findings(settings: PlatformSettings) -> Iterator[Finding]:
    from rse_pf.aws.account import open_account
    from rse_pf.aws.lifecycle.account_checks import check_account

    try:
        for check in check_account(open_account(settings.cloud.region), settings):
            yield Finding(grade=check.grade, what=check.what, fix=check.fix)
    except RsePfError as error:
        yield Finding(grade="fail", what=error.message, fix=error.hint)


def check_tools(checkout: Path) -> Iterator[Finding]:
    """Yield the results of the checks on this machine: Node, the CDK, and the packages in *checkout*.

    Nothing is requested from AWS.
    """
    yield _node()
    yield _cli(checkout)
    yield (
        Finding(grade="ok", what="packages are built")
        if are_packages_built(checkout)
        else Finding(grade="fail", what=f"{NO_PACKAGES} in {PACKAGES}", fix="make assets")
    )


def _node() -> Finding:
    fix = f"make setup installs Node {_OLDEST_NODE} or newer into .venv"
    path = os.pathsep.join((sysconfig.get_path("scripts"), os.environ.get("PATH", "")))
    program = shutil.which("node", path=path)
    if program is None:
        return Finding(grade="fail", what="Node is not installed", fix=fix)
    try:
        completed = subprocess.run(
            [program, "--version"], capture_output=True, text=True, timeout=_NODE_TIMEOUT_S, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError) as error:
        return Finding(grade="fail", what=f"Node does not run: {error}", fix=fix)
    version = re.match(r"v(\d+)\.", completed)
    if version is None or int(version[1]) < _OLDEST_NODE:
        return Finding(grade="fail", what=f"Node {completed} is too old for the CDK", fix=fix)
    return Finding(grade="ok", what=f"Node {completed}")


def _cli(checkout: Path) -> Finding:
    """Check that the CDK's command line can read the assembly schema that the CDK's library writes.

    Returns a failure if it cannot, or is not installed, and a warning if package.json pins another version.
    """
    fix = "make setup installs the one in package-lock.json; never npm install aws-cdk"
    try:
        writes = metadata.version("aws-cdk.cloud-assembly-schema")
    except metadata.PackageNotFoundError:
        return Finding(grade="fail", what="aws-cdk-lib is not installed", fix="make setup")
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


ACTION = Action(
    help="check tools, packages, account, certificate and quotas before a deployment",
    request=NoOptions,
    run=check_deployment,
)
