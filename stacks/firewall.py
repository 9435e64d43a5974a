"""The firewall of Fig. 2: robots reach the load balancer, the load balancer reaches the backend servers.

Servers reach only S3, the interface endpoints, and map servers on other backend servers.  Only the load
balancer's port is open to addresses outside of the VPC, those of ``cloud.robot_cidr``.
"""

from __future__ import annotations

from aws_cdk import aws_ec2 as ec2
from constructs import Construct

from rse_pf.config import PlatformSettings
from rse_pf.config.placement import fixed_live_ports
from rse_pf.config.resource_names import ROSBRIDGE_PORT
from rse_pf.errors import ConfigurationError
from stacks.findings import acknowledge

__all__ = ["S3_PREFIX_LISTS", "Firewall", "front_port", "inner_ports", "live_range", "s3_prefix_list"]

# Port of the load balancer without TLS.
_HTTP = 80
# Port of the load balancer with TLS, and of AWS's services.
_HTTPS = 443

S3_PREFIX_LISTS = {
    "us-east-1": "pl-63a5400a", "us-east-2": "pl-7ba54012", "us-west-1": "pl-6ba54002",
    "us-west-2": "pl-68a54001", "eu-west-1": "pl-6da54004", "eu-central-1": "pl-6ea54007",
    "ap-northeast-1": "pl-61a54008", "ap-northeast-2": "pl-78a54011", "ap-southeast-1": "pl-6fa54006",
    "ap-southeast-2": "pl-6ca54005",
}  # fmt: skip
"""Ids of AWS's managed prefix lists com.amazonaws.REGION.s3, each seen in two published route tables."""
_LOOK_UP_COMMAND = (
    "aws ec2 describe-managed-prefix-lists --filters Name=prefix-list-name,Values=com.amazonaws.{}.s3"
)


def s3_prefix_list(settings: PlatformSettings) -> str:
    """Return the id of the prefix list of S3 in ``cloud.region``, or the one in ``cloud.s3_prefix_list``.

    Raises:
        ConfigurationError: The setting is empty, and no id is known for the region.
    """
    region = settings.cloud.region
    prefix_list = settings.cloud.s3_prefix_list or S3_PREFIX_LISTS.get(region)
    if not prefix_list:
        raise ConfigurationError(
            f"no S3 prefix list is known for cloud.region = {region!r}",
            hint=f"set cloud.s3_prefix_list to the id that this prints: {_LOOK_UP_COMMAND.format(region)}",
        )
    return prefix_list


def front_port(settings: PlatformSettings) -> int:
    """Return the port of the load balancer's listener: 80 with ``cloud.allow_insecure``, else 443 for TLS."""
    return _HTTP if settings.cloud.allow_insecure else _HTTPS


class Firewall(Construct):
    """The security groups of the load balancer, the servers and the interface endpoints."""

    def __init__(
        self, scope: Construct, construct_id: str, *, vpc: ec2.IVpc, settings: PlatformSettings
    ) -> None:
        super().__init__(scope, construct_id)
        self.balancer = self._group("Balancer", vpc, "load balancer: robots in, servers out")
        self.servers = self._group("Servers", vpc, "backend servers: load balancer in, S3 and endpoints out")
        self.endpoints = self._group("Endpoints", vpc, "interface endpoints: servers in")
        self.balancer.add_ingress_rule(
            ec2.Peer.ipv4(settings.cloud.robot_cidr), ec2.Port.tcp(front_port(settings)), "robots"
        )
        self.balancer.add_ingress_rule(
            ec2.Peer.ipv4(settings.cloud.robot_cidr),
            ec2.Port.icmp_type_and_code(3, 4),
            "largest packet, RFC 1191",
        )
        acknowledge(self.balancer, "robots come from anywhere; cloud.robot_cidr narrows it", "EC23")
        for port in inner_ports(settings):
            self.balancer.add_egress_rule(self.servers, ec2.Port.tcp(port), "to the servers")
            self.servers.add_ingress_rule(self.balancer, ec2.Port.tcp(port), "from the load balancer")
        live = live_range(settings)
        if live is not None:
            ports = ec2.Port.tcp_range(live[0], live[-1])
            self.servers.add_egress_rule(self.servers, ports, "to owners of live maps")
            self.servers.add_ingress_rule(self.servers, ports, "from the other servers, to live maps")
        self.servers.add_egress_rule(
            ec2.Peer.prefix_list(s3_prefix_list(settings)), ec2.Port.tcp(_HTTPS), "S3"
        )
        self.servers.add_egress_rule(self.endpoints, ec2.Port.tcp(_HTTPS), "to the endpoints")
        self.endpoints.add_ingress_rule(self.servers, ec2.Port.tcp(_HTTPS), "from the servers")

    def _group(self, name: str, vpc: ec2.IVpc, description: str) -> ec2.SecurityGroup:
        return ec2.SecurityGroup(self, name, vpc=vpc, description=description, allow_all_outbound=False)


def inner_ports(settings: PlatformSettings) -> list[int]:
    """Return the ports of a server that the load balancer connects to, of the enabled services."""
    data = [settings.data.port] if settings.data.enabled else []
    rosbridge = [ROSBRIDGE_PORT] if settings.serving.rosbridge else []
    return [settings.serving.port, settings.serving.control_port, *data, *rosbridge]


def live_range(settings: PlatformSettings) -> range | None:
    """Return the ports of the map servers, on which backend servers reach each other; None without live maps.

    Raises:
        ConfigurationError: ``live.first_port`` is 0, so that the ports are not known beforehand.
    """
    if not settings.data.enabled or not settings.live.max_owners:
        return None
    if not settings.live.first_port:
        raise ConfigurationError(
            "live.first_port = 0 takes any free port, which the firewall of AWS cannot name",
            hint='remove live.first_port from cdk.json, context."rse-pf"',
        )
    return fixed_live_ports(settings.live)
