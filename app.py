"""Say which stacks there are.  Every number is in `rse_pf.settings`; overrides are in cdk.json."""

from __future__ import annotations

import sys
from pathlib import Path

import aws_cdk as cdk

from rse_pf.errors import RsePfError
from rse_pf.settings import PlatformSettings, load_settings
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


def main() -> int:
    """Synthesise, or say in two lines why not."""
    root = Path(__file__).parent
    try:
        app = cdk.App()
        build(app, load_settings(root / "cdk.json"), root / "build")
    except RsePfError as error:
        sys.stderr.write(f"{error.report()}\n")
        return 2
    app.synth()
    return 0


if __name__ == "__main__":
    sys.exit(main())
