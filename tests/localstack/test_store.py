"""An object store in the bucket of a stack on LocalStack, through localstack-client."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator
from typing import Any

import pytest

from rse_pf.aws.storage.key_store import KEYS_NAME
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.errors import Conflict, NotFound

TEMPLATE = {"Resources": {"Maps": {"Type": "AWS::S3::Bucket", "Properties": {}}}}
READY_S, LOOKS = 2, 30


@pytest.fixture
def session() -> Any:
    """A session of boto3 whose clients talk to LocalStack."""
    client = pytest.importorskip("localstack_client.session", reason="run make setup")
    return client.Session()


@pytest.fixture
def bucket(session: Any) -> Iterator[str]:
    """The bucket that a stack made; both are gone afterwards."""
    formation, name = session.client("cloudformation"), f"rse-pf-{uuid.uuid4().hex[:8]}"
    formation.create_stack(StackName=name, TemplateBody=json.dumps(TEMPLATE))
    waiter = {"Delay": READY_S, "MaxAttempts": LOOKS}
    formation.get_waiter("stack_create_complete").wait(StackName=name, WaiterConfig=waiter)
    (row,) = formation.list_stack_resources(StackName=name)["StackResourceSummaries"]
    yield row["PhysicalResourceId"]
    s3 = session.client("s3")
    for each in s3.list_objects_v2(Bucket=row["PhysicalResourceId"]).get("Contents", ()):
        s3.delete_object(Bucket=row["PhysicalResourceId"], Key=each["Key"])
    formation.delete_stack(StackName=name)


def test_the_bucket_of_a_stack_is_an_object_store(session: Any, bucket: str) -> None:
    store = S3Store(session.client("s3"), bucket)
    store.put(KEYS_NAME, b"one")
    store.compare_and_swap(KEYS_NAME, b"one", b"two")

    assert store.get(KEYS_NAME) == b"two"
    with pytest.raises(Conflict):
        store.compare_and_swap(KEYS_NAME, b"one", b"three")
    with pytest.raises(NotFound):
        store.get("absent.json")
