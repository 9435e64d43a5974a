"""The serverless stack: the Lambda function of `lambda_pnp` behind the load balancer.

It takes PnP commands that exceed the capacity of the servers.  Robots reach it at the address of the servers,
so that one name, one certificate and one web firewall serve both; only the load balancer may invoke it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import cast

import aws_cdk as cdk
from aws_cdk import aws_elasticloadbalancingv2 as elbv2
from aws_cdk import aws_iam as iam
from aws_cdk import aws_lambda as lambda_
from aws_cdk import aws_logs as logs
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import LAMBDA_MEMORY_MB, LOG_DAYS
from rse_pf.config.front_door import BURST_PATH
from rse_pf.config.resource_names import KEYS_NAME, ResourceNames
from rse_pf.scaling.operator_alarms import LAMBDA_TIMEOUT_S
from stacks.assets import staged
from stacks.backend_stack import TRUSTED
from stacks.findings import acknowledge
from stacks.permissions import BY_AWS, LOG_ACTIONS, allow, explain
from stacks.values import import_bucket, read

__all__ = ["ServerlessStack"]

# Number of the function's rule in the listener: after those of the data service and of rosbridge.
_RULE_PRIORITY = 20


class ServerlessStack(cdk.Stack):
    """The stack with the function, its log group, its role, its target group and its rule in the listener.

    The function reads public keys, roster and deny list from the artifact bucket.
    """

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
        artifacts = import_bucket(self, names, "artifacts")
        log = logs.LogGroup(self, "Log", removal_policy=cdk.RemovalPolicy.DESTROY)
        cast("logs.CfnLogGroup", log.node.default_child).retention_in_days = LOG_DAYS
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
                self, "Pnp", runtime=lambda_.Runtime.PYTHON_3_13, architecture=lambda_.Architecture.X86_64,
                handler="lambda_pnp.handler.handler", code=code, role=role, log_group=log,
                function_name=names.function, memory_size=LAMBDA_MEMORY_MB,
                timeout=cdk.Duration.seconds(LAMBDA_TIMEOUT_S),
                reserved_concurrent_executions=settings.cloud.lambda_concurrency,
                environment={
                    "RSE_PF_KEYS": f"{artifacts.bucket_name}/{KEYS_NAME}",
                    "RSE_PF_AWS_DOMAIN": cdk.Aws.URL_SUFFIX,
                },
            )  # fmt: skip
        acknowledge(function, "the newest runtime with wheels of every package in the lock", "L1")
        self._behind_the_load_balancer(names, function)

    def _behind_the_load_balancer(self, names: ResourceNames, function: lambda_.Function) -> None:
        # The permission names the target group, because it must exist before the target group does.
        permission = lambda_.CfnPermission(
            self, "OfLoadBalancer", action="lambda:InvokeFunction", function_name=function.function_arn,
            principal="elasticloadbalancing.amazonaws.com", source_account=self.account,
            source_arn=self.format_arn(
                service="elasticloadbalancing", resource="targetgroup", resource_name=f"{names.function}/*"
            ),
        )  # fmt: skip
        # No health checks, because each would be a paid call of the function.
        targets = elbv2.CfnTargetGroup(
            self, "Targets", name=names.function, target_type="lambda", health_check_enabled=False,
            targets=[elbv2.CfnTargetGroup.TargetDescriptionProperty(id=function.function_arn)],
            target_group_attributes=[
                # The function gets all values of a repeated header, so that it can refuse the request.
                elbv2.CfnTargetGroup.TargetGroupAttributeProperty(
                    key="lambda.multi_value_headers.enabled", value="true"
                )
            ],
        )  # fmt: skip
        targets.add_dependency(permission)
        elbv2.CfnListenerRule(
            self, "Rule", listener_arn=read(self, names, "backend/listener"), priority=_RULE_PRIORITY,
            conditions=[
                elbv2.CfnListenerRule.RuleConditionProperty(
                    field="path-pattern",
                    path_pattern_config=elbv2.CfnListenerRule.PathPatternConfigProperty(values=[BURST_PATH]),
                ),
                elbv2.CfnListenerRule.RuleConditionProperty(
                    field="http-request-method",
                    http_request_method_config=elbv2.CfnListenerRule.HttpRequestMethodConfigProperty(
                        values=["POST"]
                    ),
                ),
            ],
            actions=[elbv2.CfnListenerRule.ActionProperty(type="forward", target_group_arn=targets.ref)],
        )  # fmt: skip
        cdk.CfnOutput(
            self, "Path", value=BURST_PATH, description="takes commands by POST, at the robots' address"
        )
