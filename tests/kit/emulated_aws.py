"""An emulated AWS for tests: moto in this process, or the LocalStack that LOCALSTACK_HOST names.

`make localstack` sets LOCALSTACK_HOST, as localhost:4566.  Each test gets an account of its own there, since
LocalStack takes a key id of twelve digits as the number of an account; names of buckets are global, so that
the buckets of a test are deleted at its end.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
from collections.abc import Iterator
from typing import Any

import pytest

__all__ = ["REGION", "NoRoom", "emulated_aws", "is_localstack", "load_services", "localstack_url"]

REGION = "ap-northeast-2"
_ENVIRONMENT = "LOCALSTACK_HOST"
_FIRST_CALLS = {
    "acm": "list_certificates", "cloudformation": "list_stacks", "cloudwatch": "list_metrics",
    "ec2": "describe_vpcs", "iam": "list_roles", "lambda": "list_functions", "logs": "describe_log_groups",
    "resourcegroupstaggingapi": "get_resources", "s3": "list_buckets", "scheduler": "list_schedules",
    "secretsmanager": "list_secrets", "sns": "list_topics", "sqs": "list_queues",
    "ssm": "describe_parameters", "sts": "get_caller_identity",
}  # fmt: skip
"""A service is loaded at its first call, which takes up to 7 s: longer than our clients wait."""


def is_localstack() -> bool:
    """Return whether tests run against LocalStack."""
    return bool(os.environ.get(_ENVIRONMENT))


def localstack_url() -> str:
    """Return the address of LocalStack, as localstack-client tells it."""
    config = pytest.importorskip("localstack_client.config", reason="run make setup")
    return str(config.get_service_endpoint("s3"))


@contextlib.contextmanager
def emulated_aws(patch: pytest.MonkeyPatch, name: str) -> Iterator[None]:
    """Let boto3 talk to an account in which nothing is; *name* is the test's, and tells accounts apart."""
    if not is_localstack():
        moto = pytest.importorskip("moto", reason="run make setup")
        for variable in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(variable, "testing")
        with moto.mock_aws():
            yield
        return
    load_services()
    account = int(hashlib.sha256(name.encode()).hexdigest(), 16) % 10**12
    patch.setenv("AWS_ACCESS_KEY_ID", f"{account:012d}")
    patch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
    patch.setenv("AWS_ENDPOINT_URL", localstack_url())
    try:
        yield
    finally:
        _delete_buckets()


@functools.cache
def load_services() -> None:
    """Let LocalStack load what tests call, once in a process."""
    session = pytest.importorskip("localstack_client.session", reason="run make setup")
    for service, call in _FIRST_CALLS.items():
        with contextlib.closing(session.Session().client(service)) as client:
            getattr(client, call)()


def _delete_buckets() -> None:
    from rse_pf.aws.clients import make_client

    with contextlib.closing(make_client("s3", REGION)) as s3:
        for bucket in s3.list_buckets()["Buckets"]:
            _empty(s3, bucket["Name"])
            s3.delete_bucket(Bucket=bucket["Name"])


def _empty(s3: Any, bucket: str) -> None:
    locked = {"BypassGovernanceRetention": True} if _is_locked(s3, bucket) else {}
    for page in s3.get_paginator("list_object_versions").paginate(Bucket=bucket):
        for each in (*page.get("Versions", ()), *page.get("DeleteMarkers", ())):
            s3.delete_object(Bucket=bucket, Key=each["Key"], VersionId=each["VersionId"], **locked)
    for upload in s3.list_multipart_uploads(Bucket=bucket).get("Uploads", ()):
        s3.abort_multipart_upload(Bucket=bucket, Key=upload["Key"], UploadId=upload["UploadId"])


def _is_locked(s3: Any, bucket: str) -> bool:
    from botocore.exceptions import ClientError

    try:
        s3.get_object_lock_configuration(Bucket=bucket)
    except ClientError:
        return False
    return True


class NoRoom:
    """Service quotas of nothing at all; moto lacks a call of them."""

    def __getattr__(self, method: str) -> Any:
        return lambda **asked: {"Quota": {"Value": 0.0}}
