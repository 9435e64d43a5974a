"""The proof after a teardown names every server that still runs, however many there are."""

from __future__ import annotations

from datetime import datetime, timezone

import pytest

from rse_pf.aws.account import open_account
from rse_pf.aws.lifecycle.proof import prove
from rse_pf.config.resource_names import ResourceNames
from tests.kit.emulated_aws import is_localstack

TAG = {"Key": "rse-pf", "Value": "rse-pf"}
SERVERS = 230


# LocalStack 4 breaks off an answer with an error of its own, and the repeated call lacks the fifth page.
@pytest.mark.skipif(is_localstack(), reason="LocalStack fails within GetResources after four pages")
def test_each_of_many_servers_that_still_runs_is_named_and_no_terminated_one(region: str) -> None:
    account = open_account(region)
    ec2 = account.client("ec2")
    made = ec2.run_instances(
        ImageId=ec2.describe_images()["Images"][0]["ImageId"], MinCount=SERVERS, MaxCount=SERVERS,
        TagSpecifications=[{"ResourceType": "instance", "Tags": [TAG]}],
    )["Instances"]  # fmt: skip
    ended, *running = sorted(each["InstanceId"] for each in made)
    ec2.terminate_instances(InstanceIds=[ended])

    left = prove(account, ResourceNames(), now=datetime.now(timezone.utc)).left

    assert [arn.rpartition("/")[2] for arn in left if ":instance/" in arn] == running
