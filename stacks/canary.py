"""The canary: a Lambda function that requests one known pose through the load balancer each minute.

It connects as a robot does, to the public address, with a token that it signs by its own private key; the
operator enrols it by `rse-pf cloud canary`.  It runs outside the VPC, and may read its secret and nothing
else.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import cast

import aws_cdk as cdk
from aws_cdk import aws_events as events
from aws_cdk import aws_events_targets as targets
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_logs as logs
from aws_cdk import aws_secretsmanager as secretsmanager
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import CANARY_MB, CANARY_PERIOD_S, LOG_DAYS
from rse_pf.config.resource_names import ResourceNames
from stacks.assets import staged
from stacks.findings import acknowledge
from stacks.permissions import BY_AWS, LOG_ACTIONS, allow, explain

__all__ = ["Canary"]

# Time limit of an execution of the canary, in seconds: the handler gives up after 10 s and logs its error.
_TIMEOUT_S = 30


class Canary(Construct):
    """The canary's function, its log group, the secret with its key, and the rule that calls it each minute.

    *url* is the address of the load balancer for robots.
    """

    def __init__(
        self, scope: Construct, construct_id: str, *, settings: PlatformSettings, assets: Path, url: str
    ) -> None:
        super().__init__(scope, construct_id)
        names = ResourceNames(settings.cloud.name)
        key = secretsmanager.Secret(
            scope, "CanaryKey", description="private key of the canary's robot; rse-pf cloud canary",
            removal_policy=cdk.RemovalPolicy.DESTROY,
        )  # fmt: skip
        acknowledge(key, "rse-pf cloud canary replaces it; it can sign for the canary only", "SMG4")
        log = logs.LogGroup(self, "Log", removal_policy=cdk.RemovalPolicy.DESTROY)
        cast("logs.CfnLogGroup", log.node.default_child).retention_in_days = LOG_DAYS
        role = iam.Role(self, "Role", assumed_by=iam.ServicePrincipal("lambda.amazonaws.com"))
        allow(
            role, ["secretsmanager:GetSecretValue"], [key.secret_arn],
            used_by="rse_pf/aws/canary/handler.py:read_key",
        )  # fmt: skip
        log.grant_write(role)
        explain(role, LOG_ACTIONS, used_by=f"{BY_AWS}Lambda writes what the function prints")
        with tempfile.TemporaryDirectory() as folder:
            code = lambda_.Code.from_asset(str(staged(assets, "lambda", settings, Path(folder))))
            function = lambda_.Function(
                self, "Function", function_name=names.canary, runtime=lambda_.Runtime.PYTHON_3_13,
                architecture=lambda_.Architecture.X86_64, code=code, role=role,
                handler="rse_pf.aws.canary.handler.handler", log_group=log, memory_size=CANARY_MB,
                timeout=cdk.Duration.seconds(_TIMEOUT_S),
                environment={
                    "RSE_PF_CANARY_URL": url, "RSE_PF_CANARY_ROBOT": names.canary,
                    "RSE_PF_CANARY_SECRET": key.secret_arn,
                },
            )  # fmt: skip
        acknowledge(function, "the newest runtime with wheels of every package in the lock", "L1")
        # Without retries: each failed call counts in the metric that the alarm reads.
        function.configure_async_invoke(retry_attempts=0, max_event_age=cdk.Duration.seconds(CANARY_PERIOD_S))
        events.Rule(
            self, "EachMinute", schedule=events.Schedule.rate(cdk.Duration.seconds(CANARY_PERIOD_S)),
            targets=[targets.LambdaFunction(function, retry_attempts=0)],
        )  # fmt: skip
