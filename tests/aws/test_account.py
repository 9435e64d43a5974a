"""An operator's account: missing credentials, refusals with their code, and None for what does not exist."""

from __future__ import annotations

import contextlib
import socket
from typing import Any

import pytest

from rse_pf.aws.account import Account, open_account
from rse_pf.errors import ConfigurationError


@pytest.fixture
def signed_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """A person who never signed in."""
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))


def test_missing_credentials_are_reported_although_the_metadata_service_is_silent(
    signed_out: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("boto3", reason="run make setup")
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"http://127.0.0.1:{silent.getsockname()[1]}"
        monkeypatch.setenv("AWS_EC2_METADATA_SERVICE_ENDPOINT", address)

        with pytest.raises(ConfigurationError) as told:
            open_account("ap-northeast-2")

        assert connections_to(silent) <= 2, "each is given up after a second"

    assert told.value.message == "no AWS credentials"
    assert "aws sso login" in told.value.hint


def connections_to(listener: socket.socket) -> int:
    """Return how many connections wait to be accepted."""
    listener.setblocking(False)
    count = 0
    with contextlib.suppress(BlockingIOError):
        while True:
            listener.accept()[0].close()
            count += 1
    return count


def test_what_does_not_exist_is_none_and_has_no_pages(region: str) -> None:
    account = open_account(region)

    assert account.find("ssm", "get_parameter", Name="/nothing") is None
    assert account.find("cloudformation", "describe_stacks", StackName="nothing") is None
    rows = account.pages(
        "cloudformation", "list_stack_resources", "StackResourceSummaries", StackName="nothing"
    )
    assert rows == []


def test_a_refusal_names_the_call_and_the_code() -> None:
    errors = pytest.importorskip("botocore.exceptions", reason="run make setup")

    class Refusing:
        def get_parameter(self, **arguments: Any) -> None:
            answer = {"Error": {"Code": "AccessDeniedException"}, "ResponseMetadata": {"HTTPStatusCode": 400}}
            raise errors.ClientError(answer, "GetParameter")

    with pytest.raises(ConfigurationError) as told:
        Account("ap-northeast-2", lambda service, region: Refusing()).find("ssm", "get_parameter", Name="x")

    assert told.value.message == "AWS refuses ssm get_parameter: AccessDeniedException"


def test_an_invalid_region_is_a_configuration_error() -> None:
    pytest.importorskip("boto3", reason="run make setup")

    with pytest.raises(ConfigurationError, match=r"cloud\.region"):
        Account("Seoul!").client("s3")
