"""After a teardown: everything of ours that no living stack owns is named, and nothing of others."""

from __future__ import annotations

from typing import Any

import pytest

from rse_pf.aws.account import Account, open_account
from rse_pf.aws.cloudformation import list_living_stacks
from rse_pf.aws.lifecycle.leftovers import find_leftovers
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError

TAG = {"Key": "rse-pf", "Value": "rse-pf"}
NAMES = ResourceNames()
STACK = """{"Resources": {"Maps": {"Type": "AWS::S3::Bucket", "Properties": {
  "BucketName": "maps-of-a-stack", "Tags": [{"Key": "rse-pf", "Value": "rse-pf"}]}},
  "Log": {"Type": "AWS::Logs::LogGroup", "Properties": {"LogGroupName": "RsePf-Data-Log"}}}}"""


def fill(account: Account, region: str) -> dict[str, str]:
    """Put one of each kind of ours into *account*, and one of somebody else's beside it."""
    s3, ec2 = account.client("s3"), account.client("ec2")
    for name in ("ours", "theirs"):
        s3.create_bucket(Bucket=f"maps-{name}", CreateBucketConfiguration={"LocationConstraint": region})
        account.client("logs").create_log_group(
            logGroupName={"ours": "RsePf-Data-Log", "theirs": "log"}[name]
        )
        account.client("cloudwatch").put_metric_alarm(
            AlarmName={"ours": "rse-pf/busy", "theirs": "busy"}[name], MetricName="m", Namespace="n",
            Statistic="Sum", Period=60, Threshold=1, EvaluationPeriods=1,
            ComparisonOperator="GreaterThanThreshold",
        )  # fmt: skip
        tags: list[Any] = [TAG] if name == "ours" else []
        account.client("secretsmanager").create_secret(Name=f"key-{name}", SecretString="x", Tags=tags)
    s3.put_bucket_tagging(Bucket="maps-ours", Tagging={"TagSet": [TAG]})
    volume = ec2.create_volume(
        AvailabilityZone=f"{region}a", Size=8,
        TagSpecifications=[{"ResourceType": "volume", "Tags": [TAG]}],
    )["VolumeId"]  # fmt: skip
    ec2.create_volume(AvailabilityZone=f"{region}a", Size=8)
    subnet = ec2.describe_subnets()["Subnets"][0]["SubnetId"]
    interface = ec2.create_network_interface(
        SubnetId=subnet, TagSpecifications=[{"ResourceType": "network-interface", "Tags": [TAG]}]
    )["NetworkInterface"]["NetworkInterfaceId"]
    ec2.create_network_interface(SubnetId=subnet)
    return {
        "bucket": "maps-ours", "log group": "RsePf-Data-Log", "alarm": "rse-pf/busy", "secret": "key-ours",
        "volume": volume, "network interface": interface,
    }  # fmt: skip


def test_each_kind_of_ours_is_found_and_nothing_of_others(region: str) -> None:
    account = open_account(region)
    ours = fill(account, region)

    found = find_leftovers(account, NAMES)

    assert {each.kind: each.name for each in found} == ours
    assert len(found) == len(ours)
    for each in found:
        assert each.name in each.remove, "the command names it"
        assert each.why.startswith("kept on purpose") == (each.kind in ("bucket", "secret"))


def test_a_bucket_that_cannot_be_looked_into_is_reported_and_ends_nothing(
    region: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    account = open_account(region)
    ours = fill(account, region)
    real = account.find

    def find(service: str, method: str, **arguments: Any) -> dict[str, Any] | None:
        if method == "get_bucket_tagging" and arguments["Bucket"] == "maps-theirs":
            raise ConfigurationError("AWS refuses s3 get_bucket_tagging: AccessDenied")
        return real(service, method, **arguments)

    monkeypatch.setattr(account, "find", find)
    found = find_leftovers(account, NAMES)

    (unread,) = [each for each in found if each.unread]
    assert (unread.kind, unread.name) == ("bucket", "maps-theirs")
    assert "AccessDenied" in unread.why
    assert {each.kind: each.name for each in found if not each.unread} == ours


def test_what_a_living_stack_owns_is_no_leftover_until_it_is_gone(region: str) -> None:
    account = open_account(region)
    formation = account.client("cloudformation")
    formation.create_stack(StackName="RsePf-Data", TemplateBody=STACK)
    formation.create_stack(
        StackName="Other", TemplateBody='{"Resources": {"T": {"Type": "AWS::SNS::Topic"}}}'
    )

    assert list(list_living_stacks(account, NAMES)) == ["RsePf-Data"]
    assert find_leftovers(account, NAMES) == []

    kept = account.client("s3")
    formation.delete_stack(StackName="RsePf-Data")
    soon = {"Delay": 1, "MaxAttempts": 60}
    formation.get_waiter("stack_delete_complete").wait(StackName="RsePf-Data", WaiterConfig=soon)
    kept.create_bucket(Bucket="maps-of-a-stack", CreateBucketConfiguration={"LocationConstraint": region})
    kept.put_bucket_tagging(Bucket="maps-of-a-stack", Tagging={"TagSet": [TAG]})
    assert list(list_living_stacks(account, NAMES)) == []
    assert [each.name for each in find_leftovers(account, NAMES)] == ["maps-of-a-stack"]
