"""The network stack: a VPC in two zones, in which only the load balancer has a route to the internet."""

from __future__ import annotations

from typing import Any, cast

import aws_cdk as cdk
import jsii
from aws_cdk import aws_ec2 as ec2
from aws_cdk import aws_iam as iam
from aws_cdk import aws_logs as logs
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.cloud_layout import ENDPOINT_SERVICES, LOG_DAYS, zone_count
from rse_pf.config.resource_names import ResourceNames
from stacks.findings import acknowledge
from stacks.firewall import Firewall, front_port, inner_ports, live_range
from stacks.permissions import BY_AWS, LOG_ACTIONS, explain
from stacks.values import provide, provide_network

__all__ = ["CIDR", "ZONES", "NetworkStack"]

# Range of the addresses of the VPC.
CIDR = "10.20.0.0/16"
# Number of availability zones of the network: a load balancer needs two.
ZONES = 2
# First ephemeral port: clients receive answers on ports from here on.
_FIRST_ANSWER_PORT = 1024
# Last TCP port.
_LAST_PORT = 65535
_HTTPS = 443
# ICMP type "destination unreachable"; with the code below a router reports its largest packet (RFC 1191).
_ICMP_UNREACHABLE = 3
# ICMP code "fragmentation needed".
_ICMP_FRAGMENTATION_NEEDED = 4
_REASON_FOR_LISTS = (
    "the paper's firewall has access control lists (Sect. 3.1), in addition to security groups"
)


class NetworkStack(cdk.Stack):
    """The stack with the VPC, its endpoints, access control lists, flow logs and the firewall.

    It provides for other stacks the ids ``network/vpc``, ``network/front-N`` and ``network/servers-N`` (the
    subnets in zone N), and the security groups ``network/group-balancer``, ``network/group-servers`` and
    ``network/group-endpoints``.
    """

    def __init__(
        self,
        scope: Construct,
        construct_id: str,
        *,
        settings: PlatformSettings,
        env: cdk.Environment,
        synthesizer: cdk.IStackSynthesizer | None = None,
    ) -> None:
        super().__init__(scope, construct_id, env=env, synthesizer=synthesizer)
        self.vpc = ec2.Vpc(
            self, "Vpc", ip_addresses=ec2.IpAddresses.cidr(CIDR), max_azs=ZONES, nat_gateways=0,
            restrict_default_security_group=False,
            subnet_configuration=[
                ec2.SubnetConfiguration(
                    name="front", subnet_type=ec2.SubnetType.PUBLIC, map_public_ip_on_launch=False
                ),
                ec2.SubnetConfiguration(name="servers", subnet_type=ec2.SubnetType.PRIVATE_ISOLATED),
            ],
        )  # fmt: skip
        self.firewall = Firewall(self, "Firewall", vpc=self.vpc, settings=settings)
        self.s3 = self.vpc.add_gateway_endpoint("S3", service=ec2.GatewayVpcEndpointAwsService.S3)
        self.s3.add_to_policy(
            iam.PolicyStatement(
                principals=[iam.AnyPrincipal()],
                actions=[
                    "s3:GetObject", "s3:PutObject", "s3:DeleteObject", "s3:ListBucket",
                    "s3:AbortMultipartUpload",
                ],
                resources=["*"], conditions={"StringEquals": {"aws:ResourceAccount": self.account}},
            )
        )  # fmt: skip
        for service in ENDPOINT_SERVICES:
            self.vpc.add_interface_endpoint(
                service.capitalize(), service=ec2.InterfaceVpcEndpointAwsService(service), open=False,
                security_groups=[self.firewall.endpoints],
                subnets=ec2.SubnetSelection(subnets=self.vpc.isolated_subnets[: zone_count(settings)]),
            )  # fmt: skip
        self._control_lists(settings)
        self._flow_logs(settings)
        names = ResourceNames(settings.cloud.name)
        provide_network(self, names, self.vpc)
        for name, group in (
            ("balancer", self.firewall.balancer), ("servers", self.firewall.servers),
            ("endpoints", self.firewall.endpoints),
        ):  # fmt: skip
            provide(self, names, f"network/group-{name}", group.security_group_id)

    @property
    @jsii.member(jsii_name="availabilityZones")
    def availability_zones(self) -> list[str]:
        """The zones as CloudFormation expressions, so that the synthesis makes no request to AWS."""
        return [cdk.Fn.select(at, cdk.Fn.get_azs()) for at in range(ZONES)]

    def _control_lists(self, settings: PlatformSettings) -> None:
        """Add access control lists that allow the traffic of the security groups, and its answers.

        Access control lists keep no connection state, so answers are allowed by rules of their own.
        """
        answers = ec2.AclTraffic.tcp_port_range(_FIRST_ANSWER_PORT, _LAST_PORT)
        anywhere, inside = ec2.AclCidr.any_ipv4(), ec2.AclCidr.ipv4(self.vpc.vpc_cidr_block)
        front = self._control_list("FrontList", ec2.SubnetType.PUBLIC)
        robots = ec2.AclCidr.ipv4(settings.cloud.robot_cidr)
        self._entry(front, "Robots", 100, robots, ec2.AclTraffic.tcp_port(front_port(settings)), inward=True)
        self._entry(front, "FromServers", 110, inside, answers, inward=True)
        self._entry(front, "ToRobots", 100, robots, answers, inward=False)
        self._entry(front, "ToServers", 110, inside, answers, inward=False)
        back = self._control_list("ServerList", ec2.SubnetType.PRIVATE_ISOLATED)
        for at, port in enumerate(inner_ports(settings)):
            traffic = ec2.AclTraffic.tcp_port(port)
            self._entry(back, f"Balancer{at}", 100 + at, inside, traffic, inward=True)
        live = live_range(settings)
        if live is not None:
            traffic = ec2.AclTraffic.tcp_port_range(live[0], live[-1])
            self._entry(back, "LiveMaps", 105, inside, traffic, inward=True)
        https = ec2.AclTraffic.tcp_port(_HTTPS)
        self._entry(back, "Endpoints", 110, inside, https, inward=True)
        self._entry(back, "Answers", 120, anywhere, answers, inward=True)
        self._entry(back, "Https", 100, anywhere, https, inward=False)
        self._entry(back, "ToInside", 110, inside, answers, inward=False)
        # Without "fragmentation needed", large messages over a VPN or a cellular network would be lost.
        too_big = ec2.AclTraffic.icmp(type=_ICMP_UNREACHABLE, code=_ICMP_FRAGMENTATION_NEEDED)
        for of, peer in ((front, robots), (back, anywhere)):
            self._entry(of, "MtuIn", 140, peer, too_big, inward=True)
            self._entry(of, "MtuOut", 140, peer, too_big, inward=False)

    def _control_list(self, name: str, kind: ec2.SubnetType) -> ec2.NetworkAcl:
        where = ec2.SubnetSelection(subnet_type=kind)
        control_list = ec2.NetworkAcl(self, name, vpc=self.vpc, subnet_selection=where)
        acknowledge(control_list, _REASON_FOR_LISTS, "VPC3")
        return control_list

    def _entry(
        self, of: ec2.NetworkAcl, name: str, number: int, cidr: Any, traffic: ec2.AclTraffic, *, inward: bool
    ) -> None:
        direction = ec2.TrafficDirection.INGRESS if inward else ec2.TrafficDirection.EGRESS
        entry = of.add_entry(name, cidr=cidr, rule_number=number, traffic=traffic, direction=direction)
        acknowledge(entry, _REASON_FOR_LISTS, "VPC3")

    def _flow_logs(self, settings: PlatformSettings) -> None:
        group = logs.LogGroup(self, "FlowLog", removal_policy=cdk.RemovalPolicy.DESTROY)
        cast("logs.CfnLogGroup", group.node.default_child).retention_in_days = LOG_DAYS
        flow = self.vpc.add_flow_log("Flow", destination=ec2.FlowLogDestination.to_cloud_watch_logs(group))
        explain(
            flow, [*LOG_ACTIONS, "logs:DescribeLogStreams"],
            used_by=f"{BY_AWS}the VPC delivers its flow logs to this log group",
        )  # fmt: skip
