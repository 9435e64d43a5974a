"""The load balancer of Fig. 2: an ALB that accepts WebSockets and checks whether servers are ready."""

from __future__ import annotations

import aws_cdk as cdk
from aws_cdk import aws_ec2 as ec2
from aws_cdk import aws_elasticloadbalancingv2 as elbv2
from aws_cdk import aws_s3 as s3
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.front_door import BALANCER_IDLE_TIMEOUT_S, DATA_PATH, LOCALISE_PATH
from rse_pf.config.resource_names import READY_PATH, ROSBRIDGE_PATH, ROSBRIDGE_PORT
from rse_pf.scaling.health import CLOUD_INTERVAL_S, CLOUD_TIMEOUT_S, HEALTHY_CHECKS, cloud_checks
from stacks.data_stack import BALANCER_LOGS
from stacks.firewall import front_port
from stacks.web_firewall import WebFirewall

__all__ = ["LoadBalancer"]

# Seconds for which the connections to a removed server may continue: robots move to another one within 5 s.
_DEREGISTRATION_S = 30


class LoadBalancer(Construct):
    """The load balancer, its listener, the target groups of the enabled services, and the web firewall.

    *group* is the load balancer's security group, *logs* the bucket of its access logs.
    """

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        vpc: ec2.IVpc,
        group: ec2.ISecurityGroup,
        logs: s3.IBucket,
        settings: PlatformSettings,
    ) -> None:
        super().__init__(scope, construct_id)
        self.alb = elbv2.ApplicationLoadBalancer(
            self, "Alb", vpc=vpc, internet_facing=True, security_group=group, drop_invalid_header_fields=True,
            idle_timeout=cdk.Duration.seconds(BALANCER_IDLE_TIMEOUT_S),
            desync_mitigation_mode=elbv2.DesyncMitigationMode.STRICTEST,
        )  # fmt: skip
        # The access logs hold no request headers but Host and User-Agent (docs/security.md), so no tokens.
        self.alb.log_access_logs(logs, BALANCER_LOGS)
        self.targets = {"robots": self._targets("Robots", vpc, settings.serving.port, settings)}
        insecure = settings.cloud.allow_insecure
        self.listener = listener = self.alb.add_listener(
            "Front", port=front_port(settings), open=False,
            protocol=elbv2.ApplicationProtocol.HTTP if insecure else elbv2.ApplicationProtocol.HTTPS,
            ssl_policy=None if insecure else elbv2.SslPolicy.TLS13_RES,
            certificates=[] if insecure else [elbv2.ListenerCertificate(settings.cloud.certificate_arn)],
            default_target_groups=[self.targets["robots"]],
        )  # fmt: skip
        if settings.data.enabled:
            self.targets["data"] = self._targets("Data", vpc, settings.data.port, settings)
            listener.add_target_groups(
                "DataRule", priority=10,
                conditions=[
                    elbv2.ListenerCondition.path_patterns([f"{DATA_PATH}*", f"{LOCALISE_PATH}*"])
                ],
                target_groups=[self.targets["data"]],
            )  # fmt: skip
            # The readiness check is not reachable through the listener, because each call costs a request to
            # the bucket; the load balancer's own health checks do not pass through the listener.
            listener.add_action(
                "NotReady", priority=5,
                conditions=[elbv2.ListenerCondition.path_patterns([f"/data{READY_PATH}"])],
                action=elbv2.ListenerAction.fixed_response(404),
            )  # fmt: skip
        if settings.serving.rosbridge:
            self.targets["rosbridge"] = self._targets("Rosbridge", vpc, ROSBRIDGE_PORT, settings)
            listener.add_target_groups(
                "RosbridgeRule", priority=15,
                conditions=[elbv2.ListenerCondition.path_patterns([ROSBRIDGE_PATH])],
                target_groups=[self.targets["rosbridge"]],
            )  # fmt: skip
        WebFirewall(self, "Waf", alb_arn=self.alb.load_balancer_arn, settings=settings)

    def _targets(
        self, name: str, vpc: ec2.IVpc, port: int, settings: PlatformSettings
    ) -> elbv2.ApplicationTargetGroup:
        health = settings.health
        check_port, path = cloud_checks(settings)[name.lower()]
        return elbv2.ApplicationTargetGroup(
            self, name, vpc=vpc, port=port, protocol=elbv2.ApplicationProtocol.HTTP,
            target_type=elbv2.TargetType.INSTANCE,
            load_balancing_algorithm_type=elbv2.TargetGroupLoadBalancingAlgorithmType.LEAST_OUTSTANDING_REQUESTS,
            deregistration_delay=cdk.Duration.seconds(_DEREGISTRATION_S),
            health_check=elbv2.HealthCheck(
                path=path, port=str(check_port), healthy_http_codes="200",
                interval=cdk.Duration.seconds(CLOUD_INTERVAL_S),
                timeout=cdk.Duration.seconds(CLOUD_TIMEOUT_S),
                healthy_threshold_count=HEALTHY_CHECKS,
                unhealthy_threshold_count=health.unhealthy_checks,
            ),
        )  # fmt: skip
