"""Pass values from one stack to another through SSM parameters with fixed names.

Exports are not used: CloudFormation refuses to change or remove an export while another stack imports it, so
that a setting such as ``data.enabled`` could be turned on and never off again.  A parameter may change or be
removed at any time; the stack that reads it sees the change at its own next update.
"""

from __future__ import annotations

import aws_cdk as cdk
from aws_cdk import aws_ec2 as ec2
from aws_cdk import aws_s3 as s3
from aws_cdk import aws_ssm as ssm
from constructs import Construct

from rse_pf.config.resource_names import ResourceNames

__all__ = ["import_bucket", "import_group", "import_network", "provide", "provide_network", "read"]

_TYPE = "AWS::SSM::Parameter::Value<String>"  # CloudFormation reads the SSM parameter at each deployment


def provide(scope: Construct, names: ResourceNames, path: str, value: str) -> None:
    """Add an SSM parameter with *value* to the stack of *scope*; other stacks `read` it by *path*.

    *path* is a short name such as ``data/maps``.
    """
    stack = cdk.Stack.of(scope)
    ssm.CfnParameter(
        stack, f"{_identity(path)}Value", type="String", name=names.parameter(path), value=value,
        description="read by other stacks of this deployment",
    )  # fmt: skip


def read(scope: Construct, names: ResourceNames, path: str) -> str:
    """Return the value that another stack provides as *path*, as a token that the deployment resolves.

    The logical id of the CloudFormation parameter is *path* in camel case, such as ``DataMaps``, without a
    hash, so that acknowledged findings can name it.
    """
    stack = cdk.Stack.of(scope)
    existing = stack.node.try_find_child(_identity(path))
    if isinstance(existing, cdk.CfnParameter):
        return existing.value_as_string
    parameter = cdk.CfnParameter(stack, _identity(path), type=_TYPE, default=names.parameter(path))
    return parameter.value_as_string


def import_bucket(scope: Construct, names: ResourceNames, name: str) -> s3.IBucket:
    """Return a bucket of the data stack: ``maps``, ``artifacts``, ``audit-logs`` or ``access-logs``."""
    return s3.Bucket.from_bucket_name(scope, f"{_identity(name)}Bucket", read(scope, names, f"data/{name}"))


def import_group(scope: Construct, names: ResourceNames, name: str) -> ec2.ISecurityGroup:
    """Return the security group *name* of the firewall; its rules are written in the network stack only."""
    group_id = read(scope, names, f"network/group-{name}")
    return ec2.SecurityGroup.from_security_group_id(scope, f"{_identity(name)}Group", group_id, mutable=False)


def provide_network(scope: Construct, names: ResourceNames, vpc: ec2.Vpc) -> None:
    """Provide the ids of *vpc* and of its subnets for `import_network` in other stacks."""
    provide(scope, names, "network/vpc", vpc.vpc_id)
    for kind, subnets in (("front", vpc.public_subnets), ("servers", vpc.isolated_subnets)):
        for at, subnet in enumerate(subnets):
            provide(scope, names, f"network/{kind}-{at}", subnet.subnet_id)


def import_network(
    scope: Construct, names: ResourceNames, *, zones: int, server_zones: int, cidr: str
) -> ec2.IVpc:
    """Return the VPC of the network stack, with a public subnet in each of *zones* zones.

    Servers use the isolated subnets of the first *server_zones* zones.  The CDK requires an isolated subnet
    for each zone, and a parameter that no resource uses is a finding; therefore these subnets are repeated
    for the other zones.  *cidr* is the address range of the VPC.
    """
    front = [read(scope, names, f"network/front-{at}") for at in range(zones)]
    servers = [read(scope, names, f"network/servers-{at % server_zones}") for at in range(zones)]
    vpc = ec2.Vpc.from_vpc_attributes(
        scope, "Network", vpc_id=read(scope, names, "network/vpc"), vpc_cidr_block=cidr,
        availability_zones=[cdk.Fn.select(at, cdk.Fn.get_azs()) for at in range(zones)],
        public_subnet_ids=front, isolated_subnet_ids=servers,
    )  # fmt: skip
    # The route tables are not needed here: only the network stack adds routes.
    cdk.Annotations.of(vpc).acknowledge_warning("@aws-cdk/aws-ec2:noSubnetRouteTableId", "no route is added")
    return vpc


def _identity(path: str) -> str:
    """Return *path* in camel case, because a logical id may hold letters and digits only."""
    return "".join(word.capitalize() for word in path.replace("/", "-").split("-"))
