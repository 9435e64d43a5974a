"""The operator's AWS account: clients of one region, and calls that raise errors with a hint.

Missing credentials are reported at once; no call lasts longer than `rse_pf.aws.clients` allows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rse_pf.aws.clients import error_code, make_client, with_retries
from rse_pf.errors import ConfigurationError, MissingExtra

__all__ = ["Account", "open_account"]

_SIGN_IN = "set AWS_PROFILE, or sign in with aws sso login or aws configure"
_ABSENT = (
    "ValidationError", "ResourceNotFoundException", "NoSuchResourceException", "ParameterNotFound",
    "NoSuchBucket", "NoSuchTagSet", "InvalidInstanceID.NotFound", "InvalidInstanceID.Malformed",
)  # fmt: skip


class Account:
    """The clients of one region; each is made when it is first used."""

    def __init__(self, region: str, make: Callable[[str, str], Any] = make_client) -> None:
        self.region = region
        self._make = make
        self._clients: dict[str, Any] = {}

    def client(self, service: str) -> Any:
        """Return the client of a service; raises ConfigurationError when the region has no such service."""
        from botocore.exceptions import BotoCoreError

        if service not in self._clients:
            try:
                self._clients[service] = self._make(service, self.region)
            except (BotoCoreError, ValueError) as error:
                raise ConfigurationError(
                    f"no {service} in cloud.region = {self.region!r}: {error}", hint="correct it in cdk.json"
                ) from error
        return self._clients[service]

    def find(self, service: str, method: str, **arguments: Any) -> dict[str, Any] | None:
        """Return the answer of one call, or None when what it names does not exist.

        Raises:
            ConfigurationError: AWS refused.  The error holds no argument and no text of AWS, which may
                repeat an argument.
            StoreError: AWS does not answer.
        """
        from botocore.exceptions import ClientError

        call = getattr(self.client(service), method)
        try:
            answer: dict[str, Any] = with_retries(lambda: call(**arguments))
        except ClientError as error:
            code = error_code(error)
            if code in _ABSENT:
                return None
            raise ConfigurationError(
                f"AWS refuses {service} {method}: {code}",
                hint="check your account's permissions, or sign in again",
            ) from None
        return answer

    def change(self, service: str, method: str, **arguments: Any) -> dict[str, Any]:
        """Return the answer of one call that changes something which must exist.

        Raises:
            ConfigurationError: AWS refused, or what the call names does not exist.
            StoreError: AWS does not answer.
        """
        answer = self.find(service, method, **arguments)
        if answer is None:
            raise ConfigurationError(
                f"AWS refuses {service} {method}: it does not exist, or cannot be changed this way",
                hint="rse-pf cloud status shows what exists; then repeat the command",
            )
        return answer

    def pages(self, service: str, method: str, rows: str, **arguments: Any) -> list[Any]:
        """Return *rows* of every page of a call; none if what it names does not exist.  Raises as `find`."""
        client = self.client(service)
        if not client.can_paginate(method):
            return list((self.find(service, method, **arguments) or {}).get(rows, ()))
        collected: list[Any] = []
        token_in, token_out = _page_tokens(client.get_paginator(method))
        while True:
            page = self.find(service, method, **arguments) or {}
            collected += page.get(rows, ())
            if not page.get(token_out):
                return collected
            arguments[token_in] = page[token_out]

    def resource(self, stack: str, kind: str, prefix: str) -> str:
        """Return the physical id of a stack's resource; its logical id begins with *prefix*.

        Raises:
            ConfigurationError: There is no such stack or resource, or AWS refused.
            StoreError: AWS does not answer.
        """
        rows = self.pages("cloudformation", "list_stack_resources", "StackResourceSummaries", StackName=stack)
        for row in rows:
            if row["ResourceType"] == kind and row["LogicalResourceId"].startswith(prefix):
                return str(row["PhysicalResourceId"])
        raise ConfigurationError(
            f"there is no {prefix} in the stack {stack} in {self.region}",
            hint="put it up: rse-pf cloud up",
        )


def open_account(region: str) -> Account:
    """Return the account whose credentials boto3 finds.

    Raises:
        MissingExtra: boto3 is not installed.
        ConfigurationError: There are no credentials, or they are broken.
    """
    try:
        import boto3
        from botocore.exceptions import BotoCoreError
    except ImportError as error:
        raise MissingExtra("boto3", "aws") from error
    try:
        credentials = boto3.session.Session().get_credentials()
    except BotoCoreError as error:
        raise ConfigurationError(f"broken AWS credentials: {error}", hint=_SIGN_IN) from error
    if credentials is None:
        raise ConfigurationError("no AWS credentials", hint=_SIGN_IN)
    return Account(region)


def _page_tokens(paginator: Any) -> tuple[str, str]:
    """Return the names of a call's page token, as an argument and in the answer."""
    config = paginator._pagination_cfg  # botocore has no public name for them
    into, out = config["input_token"], config["output_token"]
    return (into, out) if isinstance(into, str) else (into[0], out[0])
