"""Pose estimation without a server: `lambda_pnp` behind a Function URL, for robots with rare requests."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import cast

import aws_cdk as cdk
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_logs as logs
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import KEYS_NAME, ResourceNames
from rse_pf.scaling.operator_alarms import LAMBDA_TIMEOUT_S
from stacks.assets import staged
from stacks.backend_stack import TRUSTED
from stacks.findings import acknowledge
from stacks.permissions import BY_AWS, LOG_ACTIONS, allow, explain
from stacks.values import imported_bucket

__all__ = ["ServerlessStack"]


class ServerlessStack(cdk.Stack):
    """The function, its URL and its log; it reads the artifact bucket."""

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: PlatformSettings,
        assets: Path,
        env: cdk.Environment,
        synthesizer: cdk.IStackSynthesizer | None = None,
    ) -> None:
        super().__init__(scope, construct_id, env=env, synthesizer=synthesizer)
        names = ResourceNames(settings.cloud.name)
        artifacts = imported_bucket(self, names, "artifacts")
        log = logs.LogGroup(self, "Log", removal_policy=cdk.RemovalPolicy.DESTROY)
        cast("logs.CfnLogGroup", log.node.default_child).retention_in_days = settings.cloud.log_days
        role = iam.Role(self, "Role", assumed_by=iam.ServicePrincipal("lambda.amazonaws.com"))
        allow(
            role, ["s3:GetObject"], [artifacts.arn_for_objects(name) for name in TRUSTED],
            used_by="lambda_pnp/keys.py:read_object",
        )  # fmt: skip
        log.grant_write(role)
        explain(role, LOG_ACTIONS, used_by=f"{BY_AWS}Lambda writes what the function prints")
        with tempfile.TemporaryDirectory() as folder:
            code = lambda_.Code.from_asset(str(staged(assets, "lambda", settings, Path(folder))))
            function = lambda_.Function(
                self, "Pnp", function_name=names.function, runtime=lambda_.Runtime.PYTHON_3_13,
                architecture=lambda_.Architecture.X86_64,
                handler="lambda_pnp.handler.handler", code=code, role=role, log_group=log,
                memory_size=settings.cloud.lambda_memory_mb,
                timeout=cdk.Duration.seconds(LAMBDA_TIMEOUT_S),
                reserved_concurrent_executions=settings.cloud.lambda_concurrency,
                environment={"RSE_PF_KEYS": f"{artifacts.bucket_name}/{KEYS_NAME}"},
            )  # fmt: skip
        acknowledge(function, "the newest runtime with wheels of every package in the lock", "L1")
        # Robots carry our own tokens, which the handler checks; AWS's signatures are not for robots.
        url = function.add_function_url(auth_type=lambda_.FunctionUrlAuthType.NONE)
        cdk.CfnOutput(self, "Url", value=url.url)
