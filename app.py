"""Say which stacks there are.  Every number is in `rse_pf.config.settings`; overrides are in cdk.json.

Promises to complain in two lines before anything is synthesised, and to let no ``-c`` of the command line
pass that nobody reads.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import aws_cdk as cdk

from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import ConfigurationError, RsePfError, SettingsError
from stacks.backend_stack import BackendStack
from stacks.data_stack import DataStack
from stacks.network_stack import NetworkStack
from stacks.observability_stack import ObservabilityStack
from stacks.serverless_stack import ServerlessStack


def build(app: cdk.App, settings: PlatformSettings, assets: Path) -> dict[str, cdk.Stack]:
    """Add the five stacks to *app*, with the packages that lie in the folder *assets*."""
    env = cdk.Environment(region=settings.cloud.region)
    network = NetworkStack(app, "RsePf-Network", settings=settings, env=env)
    data = DataStack(app, "RsePf-Data", settings=settings, env=env)
    backend = BackendStack(
        app, "RsePf-Backend", settings=settings, assets=assets, network=network, data=data, env=env
    )
    serverless = ServerlessStack(
        app, "RsePf-Serverless", settings=settings, assets=assets, data=data, env=env
    )
    observability = ObservabilityStack(
        app, "RsePf-Observability", settings=settings, backend=backend, env=env
    )
    stacks: list[cdk.Stack] = [network, data, backend, serverless, observability]
    for stack in stacks:
        cdk.Tags.of(stack).add("rse-pf", settings.digest())
    return {stack.stack_name: stack for stack in stacks}


def check_context(given: dict[str, Any], written: dict[str, Any]) -> None:
    """Refuse context of the command line that nobody would read; there is one place to edit.

    Raises:
        SettingsError: A key of *given* is neither the CDK's own nor, with the same value, in *written*.
    """
    for name, value in given.items():
        if ":" not in name and not name.startswith("@") and written.get(name) != value:
            raise SettingsError(
                f"context {name!r} of the command line is read by nobody",
                hint='write settings into cdk.json, context."rse-pf", and leave -c out',
            )


def main() -> int:
    """Synthesise, or say in two lines why not."""
    root = Path(__file__).parent
    try:
        settings = load_settings(root / "cdk.json")
        written = json.loads((root / "cdk.json").read_text(encoding="utf-8")).get("context", {})
        app = cdk.App(context=written)
        check_context(dict(app.node.get_all_context()), written)
        build(app, settings, root / "build")
    except RsePfError as error:
        return _complain(error)
    except OSError as error:
        return _complain(
            ConfigurationError(f"cannot read the packages in build: {error}", hint="run make assets")
        )
    try:
        app.synth()
    except (RuntimeError, OSError) as error:
        told = str(error).strip().splitlines() or ["no reason given"]
        return _complain(
            ConfigurationError(
                f"synthesis failed: {told[0]}", hint="look at cdk.json, and at the output folder"
            )
        )
    return 0


def _complain(error: RsePfError) -> int:
    sys.stderr.write(f"{error.report()}\n")
    return 2


if __name__ == "__main__":
    sys.exit(main())
