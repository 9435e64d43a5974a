"""Create every stack on moto: references resolve, and what moto makes is what the settings say.

moto runs no alarms, policies, hooks or checks, and ignores some types altogether.  The list of these is
exact, so that a new one is noticed; what they hold is asserted in the templates instead.
"""

from __future__ import annotations

import contextlib
import copy
import json
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from rse_pf.config.resource_names import READY_PATH, ResourceNames
from rse_pf.scaling.health import CLOUD_INTERVAL_S

boto3 = pytest.importorskip("boto3", reason="run make setup")
moto = pytest.importorskip("moto", reason="run make setup")

Assembly = Any

ORDER = ("Network", "Data", "Backend", "Serverless", "Observability")
IGNORED = {
    "AWS::AutoScaling::LifecycleHook",
    "AWS::AutoScaling::ScalingPolicy",
    "AWS::Budgets::Budget",
    "AWS::CloudWatch::Alarm",
    "AWS::EC2::NetworkAcl",
    "AWS::EC2::NetworkAclEntry",
    "AWS::EC2::SecurityGroupEgress",
    "AWS::EC2::SubnetNetworkAclAssociation",
    "AWS::Lambda::EventInvokeConfig",
    "AWS::S3::BucketPolicy",
    "AWS::SNS::TopicPolicy",
    "AWS::Scheduler::Schedule",
    "AWS::SecretsManager::Secret",
    "AWS::WAFv2::WebACL",
    "AWS::WAFv2::WebACLAssociation",
}
"""Types of ours that moto 5.2 accepts and then forgets."""

REGION = "ap-northeast-2"
_TRIED = re.compile(r"Tried to parse (\S+) but")


@dataclass
class Created:
    """What became of the stacks, and the types that moto said it ignores."""

    statuses: dict[str, str] = field(default_factory=dict)
    ignored: set[str] = field(default_factory=set)


def references(value: Any) -> Iterator[tuple[str, str]]:
    """Yield every resource that *value* reads, with the attribute."""
    if isinstance(value, dict):
        if "Ref" in value:
            yield value["Ref"], ""
        if "Fn::GetAtt" in value:
            yield value["Fn::GetAtt"][0], value["Fn::GetAtt"][1]
        for each in value.values():
            yield from references(each)
    elif isinstance(value, list):
        for each in value:
            yield from references(each)


def adapted(template: dict[str, Any], image: str) -> dict[str, Any]:
    """Return *template* without the outputs that read what moto ignores.

    The machine image is given: moto knows no parameters of Debian, and lets nobody write them.  Values that
    another stack provides are read by moto itself.
    """
    made = copy.deepcopy(template)
    for name, parameter in made.get("Parameters", {}).items():
        if "Image::Id" in parameter["Type"]:
            parameter.update(Type="String", Default=image)
        elif name == "BootstrapVersion":
            parameter.update(Type="String", Default="30")
    ignored = {name for name, each in made["Resources"].items() if each["Type"] in IGNORED}
    for name, each in made["Resources"].items():
        if each["Type"] == "AWS::SecretsManager::Secret":
            made = _replaced(made, {"Ref": name}, "arn:aws:secretsmanager:ap-northeast-2:1:secret:it")
    for name, output in list(made.get("Outputs", {}).items()):
        read = set(references(output["Value"]))
        if any(resource in ignored or attribute == "TargetGroupFullName" for resource, attribute in read):
            del made["Outputs"][name]
    for resource in made["Resources"].values():
        depends = resource.get("DependsOn", [])
        depends = [depends] if isinstance(depends, str) else depends
        resource["DependsOn"] = [name for name in depends if name not in ignored]
    return made


def _replaced(value: Any, old: Any, new: Any) -> Any:
    """Return *value* with *new* in place of each *old* in it."""
    if value == old:
        return new
    if isinstance(value, dict):
        return {name: _replaced(each, old, new) for name, each in value.items()}
    return [_replaced(each, old, new) for each in value] if isinstance(value, list) else value


@pytest.fixture
def created(assembly: Assembly, monkeypatch: pytest.MonkeyPatch) -> Iterator[Created]:
    """Every stack, created on moto in the order of a deployment."""
    with created_on_moto(assembly, monkeypatch) as made:
        yield made


@contextlib.contextmanager
def created_on_moto(assembly: Assembly, monkeypatch: pytest.MonkeyPatch) -> Iterator[Created]:
    """Create every stack of *assembly* in an account of its own."""
    cloud = assembly.settings.cloud
    names = ResourceNames(cloud.name)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN"):
        monkeypatch.setenv(name, "testing")
    monkeypatch.setenv("AWS_DEFAULT_REGION", REGION)
    monkeypatch.delenv("AWS_PROFILE", raising=False)
    with moto.mock_aws(config={"lambda": {"use_docker": False}}):
        account = boto3.client("sts", region_name=REGION).get_caller_identity()["Account"]
        image = boto3.client("ec2", region_name=REGION).describe_images()["Images"][0]["ImageId"]
        certificate = boto3.client("acm", region_name=REGION).request_certificate(DomainName="example.org")
        s3 = boto3.client("s3", region_name=REGION)
        bucket = f"cdk-{cloud.bootstrap_qualifier}-assets-{account}-{REGION}"
        s3.create_bucket(Bucket=bucket, CreateBucketConfiguration={"LocationConstraint": REGION})
        for path in sorted(assembly.folder.glob("*.assets.json")):
            for asset in json.loads(path.read_text(encoding="utf-8"))["files"].values():
                for where in asset["destinations"].values():
                    s3.put_object(Bucket=bucket, Key=where["objectKey"], Body=_EMPTY_ZIP)
        formation = boto3.client("cloudformation", region_name=REGION)
        made = Created()
        for stack in ORDER:
            template = adapted(assembly.templates[names.stack(stack)], image)
            text = json.dumps(template)
            if arn := assembly.settings.cloud.certificate_arn:  # moto wants one that it made
                text = text.replace(arn, certificate["CertificateArn"])
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                formation.create_stack(
                    StackName=names.stack(stack),
                    TemplateBody=text,
                    Capabilities=["CAPABILITY_IAM"],
                )
            made.ignored.update(_TRIED.findall(" ".join(str(each.message) for each in caught)))
            told = formation.describe_stacks(StackName=names.stack(stack))["Stacks"][0]
            made.statuses[stack] = told["StackStatus"]
        yield made


_EMPTY_ZIP = b"PK\x05\x06" + b"\0" * 18


def client(service: str) -> Any:
    """Return a client of the pretended account."""
    return boto3.client(service, region_name=REGION)


def test_every_stack_is_created_and_what_moto_made_equals_the_settings(
    created: Created, assembly: Assembly
) -> None:
    settings, scaling = assembly.settings, assembly.settings.scaling

    ignored = {each for each in IGNORED if assembly.all(each)}
    assert created.ignored == ignored, "the exact list of what moto does not make"
    assert created.statuses == dict.fromkeys(ORDER, "CREATE_COMPLETE")
    (group,) = client("autoscaling").describe_auto_scaling_groups()["AutoScalingGroups"]
    assert (group["MinSize"], group["MaxSize"]) == (scaling.min_servers, scaling.max_servers)
    assert group["HealthCheckType"] == "ELB"
    assert group["HealthCheckGracePeriod"] == 90
    elb = client("elbv2")
    targets = [
        each for each in elb.describe_target_groups()["TargetGroups"] if each.get("TargetType") != "lambda"
    ]
    robots = next(each for each in targets if each.get("Port") == settings.serving.port)
    assert robots["HealthCheckPath"] == READY_PATH
    assert robots["HealthCheckPort"] == str(settings.serving.control_port)
    assert robots["HealthCheckIntervalSeconds"] == CLOUD_INTERVAL_S
    if settings.data.enabled:
        data = next(each for each in targets if each.get("Port") == settings.data.port)
        assert data["HealthCheckPath"] == "/data/healthz"
    assert robots["UnhealthyThresholdCount"] == settings.health.unhealthy_checks
    assert (
        len(targets)
        == len(group["TargetGroupARNs"])
        == 1 + settings.data.enabled + settings.serving.rosbridge
    )
    (balancer,) = elb.describe_load_balancers()["LoadBalancers"]
    (listener,) = elb.describe_listeners(LoadBalancerArn=balancer["LoadBalancerArn"])["Listeners"]
    expected = ("HTTP", 80) if settings.cloud.allow_insecure else ("HTTPS", 443)
    assert (listener["Protocol"], listener["Port"]) == expected
    buckets = [each["Name"] for each in client("s3").list_buckets()["Buckets"]]
    for word in ("map", "artifact", "log"):
        assert any(word in name.lower() for name in buckets), (word, buckets)
    functions = client("lambda").list_functions()["Functions"]
    (function,) = [each for each in functions if each["FunctionName"] == ResourceNames().function]
    assert function["MemorySize"] == 1769
    assert function["Timeout"] == 10
    groups = client("ec2").describe_security_groups()["SecurityGroups"]
    open_to_all = [
        (each["GroupName"], rule.get("FromPort"))
        for each in groups
        if each["GroupName"] != "default"
        for rule in each["IpPermissions"]
        for cidr in rule.get("IpRanges", [])
        if cidr["CidrIp"] == "0.0.0.0/0"
    ]
    front = 80 if settings.cloud.allow_insecure else 443
    assert [port for _, port in open_to_all] == [front, 3], "the listener; ICMP type 3: the largest packet"
