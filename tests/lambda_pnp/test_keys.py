"""The signed GET of the key set."""

from __future__ import annotations

from datetime import datetime, timezone

import pytest

from lambda_pnp.keys import signed_request

ENVIRONMENT = {
    "RSE_PF_KEYS": "artifacts/keys.json", "AWS_REGION": "ap-northeast-2", "AWS_ACCESS_KEY_ID": "AKIDEXAMPLE",
    "AWS_SECRET_ACCESS_KEY": "secret", "AWS_SESSION_TOKEN": "session",
}  # fmt: skip
NOW = datetime(2026, 11, 21, 6, 0, 0, tzinfo=timezone.utc)


def test_the_signature_is_the_one_that_the_aws_sdk_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    auth = pytest.importorskip("botocore.auth", reason="the aws extra is not installed")
    from botocore.awsrequest import AWSRequest
    from botocore.credentials import Credentials

    request = signed_request(ENVIRONMENT, NOW)
    theirs = AWSRequest(method="GET", url=request.full_url)
    signer = auth.S3SigV4Auth(Credentials("AKIDEXAMPLE", "secret", "session"), "s3", "ap-northeast-2")
    module = auth if hasattr(auth, "get_current_datetime") else None
    if module is None:
        pytest.skip("this botocore reads its clock elsewhere")
    monkeypatch.setattr(module, "get_current_datetime", lambda *_: NOW.replace(tzinfo=None))
    signer.add_auth(theirs)

    assert request.get_header("Authorization") == theirs.headers["Authorization"]


def test_the_request_goes_to_the_bucket_by_tls() -> None:
    request = signed_request(ENVIRONMENT, NOW)

    assert request.full_url == "https://artifacts.s3.ap-northeast-2.amazonaws.com/keys.json"
    assert request.get_header("X-amz-security-token") == "session"
    assert "secret" not in str(request.header_items())
