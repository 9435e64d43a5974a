"""Synthesise the stacks of the platform.  Settings come from `rse_pf.config`; overrides are in cdk.json."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import aws_cdk as cdk

from rse_pf.config import PlatformSettings, load_settings
from rse_pf.config.resource_names import DEPLOYMENT_TAG, SETTINGS_CONTEXT, ResourceNames
from rse_pf.errors import RsePfError, SettingsError
from stacks.backend_stack import BackendStack
from stacks.data_stack import DataStack
from stacks.network_stack import NetworkStack
from stacks.observability_stack import ObservabilityStack
from stacks.serverless_stack import ServerlessStack


def build(app: cdk.App, settings: PlatformSettings, assets: Path) -> dict[str, cdk.Stack]:
    """Add the five stacks to *app*, with the packages in the folder *assets*; return them by name.

    The stacks share no CDK objects: values pass from one to another by SSM parameters (`stacks.values`), and
    the dependencies below only say which stack is deployed before which.
    """
    names, env = ResourceNames(settings.cloud.name), cdk.Environment(region=settings.cloud.region)

    def common() -> Any:
        qualifier = settings.cloud.bootstrap_qualifier
        return {
            "settings": settings, "env": env, "synthesizer": cdk.DefaultStackSynthesizer(qualifier=qualifier),
        }  # fmt: skip

    network = NetworkStack(app, names.stack("Network"), **common())
    data = DataStack(app, names.stack("Data"), **common())
    backend = BackendStack(app, names.stack("Backend"), assets=assets, **common())
    serverless = ServerlessStack(app, names.stack("Serverless"), assets=assets, **common())
    observability = ObservabilityStack(app, names.stack("Observability"), assets=assets, **common())
    for reader, providers in (
        (backend, [network, data]), (serverless, [data, backend]), (observability, [backend, data]),
    ):  # fmt: skip
        for provider in providers:
            reader.add_stack_dependency(provider)
    stacks: list[cdk.Stack] = [network, data, backend, serverless, observability]
    for stack in stacks:
        # SSM parameters get no tag: they are found by name, and emulators take their tags in another form.
        untagged = ["AWS::SSM::Parameter"]
        cdk.Tags.of(stack).add(DEPLOYMENT_TAG, names.prefix, exclude_resource_types=untagged)
        cdk.CfnOutput(stack, "Settings", value=settings.digest(), description="digest of the settings")
    return {stack.stack_name: stack for stack in stacks}


def check_context(given: dict[str, Any], written: dict[str, Any]) -> None:
    """Raise SettingsError if a key of the context *given* has another value in *written*, that of cdk.json.

    Keys of the CDK itself, which contain ``:`` or begin with ``@``, are ignored.
    """
    for name, value in given.items():
        if ":" not in name and not name.startswith("@") and written.get(name) != value:
            hint = 'write settings into cdk.json, context."rse-pf", and leave -c out'
            raise SettingsError(f"context {name!r} of the command line is not used", hint=hint)


def settings_file(given: dict[str, Any], root: Path) -> Path:
    """Return the settings file that the context *given* names (`SETTINGS_CONTEXT`), or cdk.json in *root*."""
    named = given.get(SETTINGS_CONTEXT)
    return Path(named) if named else root / "cdk.json"


def main() -> int:
    """Synthesise all stacks and return 0; on an error print it with its hint in two lines and return 2."""
    root = Path(__file__).parent
    try:
        load_settings(root / "cdk.json")  # reports invalid JSON as an error of two lines, not as a traceback
        written = json.loads((root / "cdk.json").read_text(encoding="utf-8")).get("context", {})
        app = cdk.App(context=written)
        given = dict(app.node.get_all_context())
        check_context(given, written)
        settings = load_settings(settings_file(given, root))
        build(app, settings, root / "build")
        app.synth()
    except RsePfError as error:
        sys.stderr.write(f"{error.report()}\n")
        return 2
    except (RuntimeError, OSError) as error:
        reason = (str(error).strip().splitlines() or ["no reason given"])[0]
        sys.stderr.write(f"synthesis failed: {reason}\n  hint: check cdk.json, build and the output folder\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
