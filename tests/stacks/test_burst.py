"""The burst function in the templates: reached through the load balancer alone, and only with a token."""

from __future__ import annotations

import re
import time
from typing import Any

import pytest

from rse_pf.auth.tokens import SigningKey
from rse_pf.config.front_door import BURST_PATH

Assembly = Any


def resources(assembly: Assembly, stack: str, kind: str) -> dict[str, Any]:
    found = assembly.templates[stack]["Resources"].items()
    return {name: each["Properties"] for name, each in found if each["Type"] == kind}


@pytest.fixture
def firewall(assembly: Assembly) -> list[dict[str, Any]]:
    (acl,) = resources(assembly, "RsePf-Backend", "AWS::WAFv2::WebACL").values()
    rules: list[dict[str, Any]] = acl["Rules"]
    return rules


def blocks(statement: Any, path: str, authorization: str | None) -> bool:
    """Judge a request as AWS WAF does; a header that is missing matches nothing."""
    ((kind, inside),) = statement.items()
    if kind == "AndStatement":
        return all(blocks(each, path, authorization) for each in inside["Statements"])
    if kind == "NotStatement":
        return not blocks(inside["Statement"], path, authorization)
    if kind == "ByteMatchStatement":
        assert inside["FieldToMatch"] == {"UriPath": {}}
        assert inside["PositionalConstraint"] == "STARTS_WITH"
        return path.startswith(inside["SearchString"])
    assert kind == "RegexMatchStatement"
    assert inside["FieldToMatch"] == {"SingleHeader": {"Name": "authorization"}}
    return authorization is not None and re.search(inside["RegexString"], authorization) is not None


def token() -> str:
    from rse_pf.config import PlatformSettings

    key = SigningKey.from_seed(bytes(range(32)), "k")
    return key.issue("robot-1", now=time.time(), token_id="t", settings=PlatformSettings().auth)


def test_a_call_without_what_looks_like_a_token_never_reaches_the_function(firewall: Any) -> None:
    (rule,) = [each for each in firewall if each["Name"] == "burst-needs-a-token"]
    signed = f"Bearer {token()}"

    for wrong in (None, "", "Bearer", "Bearer x", "Basic dXNlcjpwYXNz", signed[:-1], f"{signed} {signed}"):
        assert blocks(rule["Statement"], BURST_PATH, wrong), wrong
    assert not blocks(rule["Statement"], BURST_PATH, signed)
    assert not blocks(rule["Statement"], "/ws", None)
    assert rule["Action"]["Block"]["CustomResponse"]["ResponseCode"] == 401


def test_calls_without_what_looks_like_a_token_are_blocked_before_any_rate_counts_them(firewall: Any) -> None:
    first = min(firewall, key=lambda each: int(each["Priority"]))

    assert first["Name"] == "burst-needs-a-token", "strangers would use up the commands of all robots"
    assert len({each["Priority"] for each in firewall}) == len(firewall)


def test_calls_with_an_invented_token_are_bounded_by_address_and_in_all(
    assembly: Assembly, firewall: Any
) -> None:
    rates = {
        each["Name"]: each["Statement"]["RateBasedStatement"]
        for each in firewall
        if "RateBasedStatement" in each["Statement"]
    }
    burst = assembly.settings.burst

    assert rates["burst"]["Limit"] == 0.4 * burst.commands_per_5_minutes
    assert rates["burst-of-all"]["Limit"] == burst.commands_per_5_minutes
    assert rates["burst-of-all"]["AggregateKeyType"] == "CONSTANT"


def test_only_the_load_balancer_may_invoke_the_function(assembly: Assembly) -> None:
    stack = "RsePf-Serverless"
    (permission,) = resources(assembly, stack, "AWS::Lambda::Permission").values()

    assert not assembly.all("AWS::Lambda::Url")
    assert permission["Principal"] == "elasticloadbalancing.amazonaws.com"
    assert permission["SourceAccount"] == {"Ref": "AWS::AccountId"}
    (name,) = [
        each["Name"]
        for each in resources(assembly, stack, "AWS::ElasticLoadBalancingV2::TargetGroup").values()
    ]
    assert permission["SourceArn"]["Fn::Join"][1][-1] == f":targetgroup/{name}/*"


def test_the_rule_forwards_posts_of_one_path_with_lists_of_header_values(assembly: Assembly) -> None:
    stack = "RsePf-Serverless"
    (rule,) = resources(assembly, stack, "AWS::ElasticLoadBalancingV2::ListenerRule").values()
    ((identity, targets),) = resources(assembly, stack, "AWS::ElasticLoadBalancingV2::TargetGroup").items()
    conditions = {each["Field"]: each for each in rule["Conditions"]}
    others = resources(assembly, "RsePf-Backend", "AWS::ElasticLoadBalancingV2::ListenerRule").values()

    assert conditions["path-pattern"]["PathPatternConfig"]["Values"] == [BURST_PATH]
    assert conditions["http-request-method"]["HttpRequestMethodConfig"]["Values"] == ["POST"]
    assert rule["Actions"] == [{"TargetGroupArn": {"Ref": identity}, "Type": "forward"}]
    assert rule["Priority"] not in {each["Priority"] for each in others}
    assert targets["TargetType"] == "lambda"
    assert targets["HealthCheckEnabled"] is False, "each check would be a call that is paid for"
    attributes = {each["Key"]: each["Value"] for each in targets["TargetGroupAttributes"]}
    assert attributes == {"lambda.multi_value_headers.enabled": "true"}


def test_the_function_has_a_bounded_number_of_executions_outside_of_the_network(assembly: Assembly) -> None:
    (function,) = resources(assembly, "RsePf-Serverless", "AWS::Lambda::Function").values()

    assert function["ReservedConcurrentExecutions"] == assembly.settings.cloud.lambda_concurrency
    assert "VpcConfig" not in function


def test_the_function_writes_nothing_but_its_log(assembly: Assembly) -> None:
    (policy,) = resources(assembly, "RsePf-Serverless", "AWS::IAM::Policy").values()
    actions = {
        action
        for each in policy["PolicyDocument"]["Statement"]
        for action in ([each["Action"]] if isinstance(each["Action"], str) else each["Action"])
    }

    assert actions == {"s3:GetObject", "logs:CreateLogStream", "logs:PutLogEvents"}
