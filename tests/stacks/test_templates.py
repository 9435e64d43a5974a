"""The templates say what the settings say, and nothing wider."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import READY_PATH
from rse_pf.errors import ConfigurationError
from rse_pf.scaling.alarms import Alarm, Metric, alarms_of
from rse_pf.scaling.health import CLOUD_INTERVAL_S, CLOUD_TIMEOUT_S
from rse_pf.scaling.rules import ScalingStep

Assembly = Any

NEEDLESS = {"W3005"}
"""A DependsOn that a reference implies already: the CDK writes these for roles, and they do no harm."""


def parsed_alarms(assembly: Assembly) -> list[Alarm]:
    """Read the scaling alarms, with their policies, back out of the template."""
    resources = assembly.templates["RsePf-Backend"]["Resources"]
    found = []
    for resource in resources.values():
        if resource["Type"] != "AWS::CloudWatch::Alarm":
            continue
        alarm = resource["Properties"]
        policy = resources[alarm["AlarmActions"][0]["Ref"]]["Properties"]
        *series, verdict = alarm["Metrics"]
        found.append(
            Alarm(
                name=alarm["AlarmName"].removeprefix("rse-pf/"),
                metrics=tuple(
                    Metric(
                        name=each["Id"],
                        namespace=each["MetricStat"]["Metric"]["Namespace"],
                        metric=each["MetricStat"]["Metric"]["MetricName"],
                        statistic=each["MetricStat"]["Stat"],
                    )
                    for each in series
                ),
                expression=verdict["Expression"],
                comparison=alarm["ComparisonOperator"],
                threshold=alarm["Threshold"],
                period_s=series[0]["MetricStat"]["Period"],
                periods=alarm["EvaluationPeriods"],
                missing=alarm["TreatMissingData"],
                steps=tuple(
                    ScalingStep(
                        lower=each.get("MetricIntervalLowerBound"),
                        upper=each.get("MetricIntervalUpperBound"),
                        change=each["ScalingAdjustment"],
                    )
                    for each in policy["StepAdjustments"]
                ),
                meaning=alarm["AlarmDescription"].partition(";")[0],
            )
        )
    return found


def test_the_alarms_in_the_template_are_those_of_the_policy(assembly: Assembly) -> None:
    expected = alarms_of(assembly.settings.scaling)

    assert sorted(parsed_alarms(assembly), key=lambda each: each.name) == sorted(
        expected, key=lambda each: each.name
    )


def test_the_group_has_the_settings_bounds_and_asks_the_load_balancer(assembly: Assembly) -> None:
    group, scaling = assembly.one("AWS::AutoScaling::AutoScalingGroup"), assembly.settings.scaling

    assert (group["MinSize"], group["MaxSize"]) == (str(scaling.min_servers), str(scaling.max_servers))
    assert group["HealthCheckType"] == "ELB"
    assert group["HealthCheckGracePeriod"] == 90
    assert group["DefaultInstanceWarmup"] == scaling.warm_up_s
    services = 1 + assembly.settings.data.enabled + assembly.settings.serving.rosbridge
    assert len(group["TargetGroupARNs"]) == services


def test_alarms_of_this_account_may_publish_to_the_topic_and_nobody_without_tls(assembly: Assembly) -> None:
    statements = assembly.one("AWS::SNS::TopicPolicy")["PolicyDocument"]["Statement"]
    allowed = [each for each in statements if each["Effect"] == "Allow"]

    assert [each["Principal"] for each in allowed] == [
        {"Service": ["budgets.amazonaws.com", "cloudwatch.amazonaws.com"]}
    ]
    assert allowed[0]["Condition"] == {"StringEquals": {"aws:SourceAccount": {"Ref": "AWS::AccountId"}}}
    assert [each["Condition"] for each in statements if each["Effect"] == "Deny"] == [
        {"Bool": {"aws:SecureTransport": "false"}}
    ]


def test_no_role_may_do_anything_to_everything_but_publish_and_read_numbers(assembly: Assembly) -> None:
    statements = [
        each
        for policy in assembly.all("AWS::IAM::Policy")
        for each in policy["PolicyDocument"]["Statement"]
        if each["Effect"] == "Allow"
    ]

    assert len(statements) >= 6
    wide = [each for each in statements if each["Resource"] == "*"]
    assert [(each["Action"], each.get("Condition")) for each in wide] == [
        ("cloudwatch:PutMetricData", {"StringEquals": {"cloudwatch:namespace": "RsePf"}}),
        ("cloudwatch:GetMetricData", None),
        # The idle timer: reading, which knows no resources.
        (
            [
                "autoscaling:DescribeAutoScalingGroups",
                "cloudwatch:DescribeAlarms",
                "cloudwatch:GetMetricData",
            ],
            None,
        ),
    ]
    actions = [action for each in statements for action in _listed(each["Action"])]
    assert not [action for action in actions if "*" in action]
    assert not [action for action in actions if action.startswith(("kms:", "iam:"))]
    secrets = [each for each in statements if "secretsmanager:" in str(each["Action"])]
    assert all("CanaryKey" in json.dumps(each["Resource"]) for each in secrets), (
        "no server and no function may read the signing key"
    )


def _listed(value: str | list[str]) -> list[str]:
    return [value] if isinstance(value, str) else value


def test_what_the_commands_look_for_is_what_the_stacks_call_it(assembly: Assembly) -> None:
    from rse_pf.auth.trust_store import DENY_NAME, ROBOTS_NAME
    from rse_pf.aws.storage.key_store import KEYS_NAME
    from rse_pf.config.cloud_layout import ENDPOINT_SERVICES, zone_count
    from rse_pf.config.resource_names import ResourceNames
    from stacks import backend_stack

    (group,) = assembly.all("AWS::AutoScaling::AutoScalingGroup")
    assert group["AutoScalingGroupName"] == ResourceNames().group
    assert {KEYS_NAME, ROBOTS_NAME, DENY_NAME} == set(backend_stack.TRUSTED)
    resources = assembly.templates[ResourceNames().stack("Data")]["Resources"]
    for word, kind in (
        ("SigningKey", "AWS::SecretsManager::Secret"), ("Artifacts", "AWS::S3::Bucket"),
        ("AuditLogs", "AWS::S3::Bucket"),
    ):  # fmt: skip
        assert [each["Type"] for name, each in resources.items() if name.startswith(word)].count(kind) == 1
    interfaces = [
        each for each in assembly.all("AWS::EC2::VPCEndpoint") if each["VpcEndpointType"] == "Interface"
    ]
    assert len(interfaces) == len(ENDPOINT_SERVICES)
    assert {len(each["SubnetIds"]) for each in interfaces} == {zone_count(assembly.settings)}


def test_servers_reach_the_map_bucket_exactly_when_the_data_service_runs(assembly: Assembly) -> None:
    statements = [
        statement
        for policy in assembly.all("AWS::IAM::Policy")
        for statement in policy["PolicyDocument"]["Statement"]
        if "s3:DeleteObject" in _listed(statement["Action"])
    ]
    script = json.dumps(assembly.one("AWS::EC2::LaunchTemplate")["LaunchTemplateData"]["UserData"])
    named = [word for word in ("store", "Maps") if f"{word}" in script]

    if not assembly.settings.data.enabled:
        assert statements == []
        assert "s3:" not in script.partition("store")[2][:12]
        assert "Maps" not in script
        return
    (statement,) = statements
    assert sorted(_listed(statement["Action"])) == [
        "s3:AbortMultipartUpload", "s3:DeleteObject", "s3:GetObject", "s3:PutObject",
    ]  # fmt: skip
    assert "Maps" in json.dumps(statement["Resource"])
    assert named == ["store", "Maps"]
    (gate,) = [
        each["PolicyDocument"]["Statement"]
        for each in assembly.all("AWS::EC2::VPCEndpoint")
        if each["VpcEndpointType"] == "Gateway"
    ]
    let_through = {action for one in gate for action in _listed(one["Action"])}
    assert {*_listed(statement["Action"]), "s3:ListBucket"} <= let_through


def test_the_target_group_checks_the_control_port_as_the_settings_say(assembly: Assembly) -> None:
    health, serving = assembly.settings.health, assembly.settings.serving
    groups = assembly.all("AWS::ElasticLoadBalancingV2::TargetGroup")
    group = next(each for each in groups if each.get("Port") == serving.port)

    assert group["HealthCheckPort"] == str(serving.control_port)
    assert group["HealthCheckPath"] == READY_PATH
    assert group["HealthCheckIntervalSeconds"] == CLOUD_INTERVAL_S
    assert group["HealthCheckTimeoutSeconds"] == CLOUD_TIMEOUT_S
    assert group["UnhealthyThresholdCount"] == health.unhealthy_checks
    attributes = {each["Key"]: each["Value"] for each in group["TargetGroupAttributes"]}
    assert attributes["load_balancing.algorithm.type"] == "least_outstanding_requests"
    assert attributes["deregistration_delay.timeout_seconds"] == "30"


def test_the_front_door_speaks_tls_unless_it_is_a_lab(assembly: Assembly) -> None:
    listener = assembly.one("AWS::ElasticLoadBalancingV2::Listener")
    url = assembly.templates["RsePf-Backend"]["Outputs"]["Url"]["Value"]

    if assembly.settings.cloud.allow_insecure:
        assert (listener["Port"], listener["Protocol"]) == (80, "HTTP")
        assert json.dumps(url).count("ws://") == 1
    else:
        assert (listener["Port"], listener["Protocol"]) == (443, "HTTPS")
        assert listener["SslPolicy"] == "ELBSecurityPolicy-TLS13-1-2-Res-2021-06"
        assert url == "wss://robots.example.org/ws"


def test_nobody_outside_can_have_the_data_service_ask_its_store(assembly: Assembly) -> None:
    rules = {rule["Priority"]: rule for rule in assembly.all("AWS::ElasticLoadBalancingV2::ListenerRule")}
    del rules[20]  # of the burst function
    rosbridge = rules.pop(15, None)
    assert (rosbridge is not None) == assembly.settings.serving.rosbridge
    if rosbridge is not None:
        assert rosbridge["Conditions"][0]["PathPatternConfig"]["Values"] == ["/rosbridge"]
    if not assembly.settings.data.enabled:
        assert rules == {}
        return

    assert sorted(rules) == [5, 10], "the first that fits decides"
    assert rules[5]["Conditions"][0]["PathPatternConfig"]["Values"] == ["/data/readyz"]
    assert rules[5]["Actions"] == [{"Type": "fixed-response", "FixedResponseConfig": {"StatusCode": "404"}}]


def test_only_the_front_door_is_open_to_the_world(assembly: Assembly) -> None:
    inline = [
        rule
        for group in assembly.all("AWS::EC2::SecurityGroup")
        for rule in group.get("SecurityGroupIngress", [])
    ]
    outward = [
        rule
        for group in assembly.all("AWS::EC2::SecurityGroup")
        for rule in group.get("SecurityGroupEgress", [])
    ]
    loose = [*assembly.all("AWS::EC2::SecurityGroupIngress"), *assembly.all("AWS::EC2::SecurityGroupEgress")]
    front = 80 if assembly.settings.cloud.allow_insecure else 443

    open_to_all = [rule for rule in inline if rule.get("CidrIp") == "0.0.0.0/0"]
    ports = [(rule["IpProtocol"], rule["FromPort"], rule["ToPort"]) for rule in open_to_all]
    assert ports == [("tcp", front, front), ("icmp", 3, 4)], "the listener, and what a path's MTU needs"
    assert not [rule for rule in [*outward, *loose] if rule.get("CidrIp") == "0.0.0.0/0"]


def test_instances_have_no_key_no_public_address_and_imdsv2_with_one_hop(assembly: Assembly) -> None:
    data = assembly.one("AWS::EC2::LaunchTemplate")["LaunchTemplateData"]

    assert "KeyName" not in data
    assert data["MetadataOptions"]["HttpTokens"] == "required"
    assert data["MetadataOptions"]["HttpPutResponseHopLimit"] == 1
    assert data["Monitoring"] == {"Enabled": True}
    assert data["BlockDeviceMappings"][0]["Ebs"]["Encrypted"] is True
    assert data["NetworkInterfaces"][0]["AssociatePublicIpAddress"] is False


def test_every_bucket_is_private_versioned_encrypted_and_kept(assembly: Assembly) -> None:
    buckets = [
        each
        for each in assembly.templates["RsePf-Data"]["Resources"].values()
        if each["Type"] == "AWS::S3::Bucket"
    ]

    assert len(buckets) == 4
    for bucket in buckets:
        assert bucket["DeletionPolicy"] == "Retain"
        assert set(bucket["Properties"]["PublicAccessBlockConfiguration"].values()) == {True}
        assert bucket["Properties"]["VersioningConfiguration"] == {"Status": "Enabled"}
        assert "BucketEncryption" in bucket["Properties"]


def test_audit_logs_are_written_once_and_read_changed_or_deleted_by_no_server(assembly: Assembly) -> None:
    lock = {"Mode": "GOVERNANCE", "Days": assembly.settings.cloud.audit_days}
    (bucket,) = [each for each in assembly.all("AWS::S3::Bucket") if each.get("ObjectLockEnabled")]
    statements = [
        statement
        for policy in assembly.all("AWS::IAM::Policy")
        for statement in policy["PolicyDocument"]["Statement"]
        if "DataAuditLogs" in json.dumps(statement["Resource"])
    ]

    assert bucket["ObjectLockConfiguration"]["Rule"]["DefaultRetention"] == lock
    assert (
        min(rule["ExpirationInDays"] for rule in bucket["LifecycleConfiguration"]["Rules"])
        > assembly.settings.cloud.audit_days
    ), "what is locked cannot expire"
    (statement,) = statements
    assert (statement["Effect"], statement["Action"]) == ("Allow", "s3:PutObject")
    assert statement["Condition"] == {"Null": {"s3:if-none-match": "false"}}
    assert statement["Resource"]["Fn::Join"][1][-1] == "/audit/*"


def test_synthesis_asks_nobody(assembly: Assembly) -> None:
    manifest = json.loads((assembly.folder / "manifest.json").read_text(encoding="utf-8"))

    assert not manifest.get("missing")


def test_no_stack_holds_on_to_a_value_of_another(assembly: Assembly) -> None:
    """CloudFormation refuses to remove an export that is imported: a switch could not be turned off again."""
    text = json.dumps(assembly.templates)
    provided = {each["Name"] for each in assembly.all("AWS::SSM::Parameter")}
    wanted = {
        parameter["Default"]
        for template in assembly.templates.values()
        for parameter in template["Parameters"].values()
        if parameter["Default"].startswith("/rse-pf/")
    }

    assert "Fn::ImportValue" not in text
    assert '"Export"' not in text
    assert len(wanted) >= 12
    assert wanted <= provided, "read, and written by no stack"


def test_a_stack_is_deployed_after_those_whose_values_it_reads(assembly: Assembly) -> None:
    manifest = json.loads((assembly.folder / "manifest.json").read_text(encoding="utf-8"))
    writers = {
        resource["Properties"]["Name"]: stack
        for stack, template in assembly.templates.items()
        for resource in template["Resources"].values()
        if resource["Type"] == "AWS::SSM::Parameter"
    }

    for stack, template in assembly.templates.items():
        reads = {writers.get(each["Default"]) for each in template["Parameters"].values()} - {None}
        assert reads <= set(manifest["artifacts"][stack]["dependencies"]), stack


def test_nag_finds_nothing_that_is_not_acknowledged(assembly: Assembly) -> None:
    found = [each["ruleName"] for each in assembly.findings]

    assert found == (["Annotation::rse-pf:allow-insecure"] if assembly.settings.cloud.allow_insecure else [])


Lint = Callable[[Any], list[str]]


@pytest.fixture(scope="session")
def lint() -> Lint:
    """Return what cfn-lint finds in a template; its rules are loaded once, which takes most of the time."""
    api = pytest.importorskip("cfnlint.api", reason="cfn-lint is not installed")
    from cfnlint.config import ConfigMixIn
    from cfnlint.core import get_rules

    config = ConfigMixIn()
    rules = get_rules([], config.ignore_checks, config.include_checks)
    regions = [PlatformSettings().cloud.region]
    return lambda template: [
        str(each)
        for each in api.lint(json.dumps(template), rules=rules, regions=regions)
        if each.rule.id not in NEEDLESS
    ]


def test_cfn_lint_finds_nothing(assembly: Assembly, lint: Lint) -> None:
    for template in assembly.templates.values():
        assert lint(template) == []


def test_missing_packages_are_one_line_and_a_hint(tmp_path: Path) -> None:
    from stacks.assets import staged

    with pytest.raises(ConfigurationError) as told:
        staged(tmp_path / "build", "servers", PlatformSettings(), tmp_path)

    assert told.value.hint == "run make assets"
    assert "\n" not in told.value.message


def test_the_firewall_keeps_no_samples_of_requests(assembly: Assembly) -> None:
    (acl,) = [
        each["Properties"]
        for each in assembly.templates["RsePf-Backend"]["Resources"].values()
        if each["Type"] == "AWS::WAFv2::WebACL"
    ]

    seen = [acl["VisibilityConfig"], *(rule["VisibilityConfig"] for rule in acl["Rules"])]
    assert [each["SampledRequestsEnabled"] for each in seen] == [False] * len(seen)


def test_the_load_balancer_refuses_what_two_readers_may_understand_differently(assembly: Assembly) -> None:
    balancer = assembly.one("AWS::ElasticLoadBalancingV2::LoadBalancer")
    chosen = {each["Key"]: each["Value"] for each in balancer["LoadBalancerAttributes"]}

    assert chosen["routing.http.desync_mitigation_mode"] == "strictest"
    assert chosen["routing.http.drop_invalid_header_fields.enabled"] == "true"
