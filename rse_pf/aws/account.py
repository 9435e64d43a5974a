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
# Error codes by which AWS says that the resource of a call does not exist.
_NOT_FOUND_CODES = (
    "ValidationError", "ResourceNotFoundException", "NoSuchResourceException", "ParameterNotFound",
    "NoSuchBucket", "NoSuchTagSet", "InvalidInstanceID.NotFound", "InvalidInstanceID.Malformed",
)  # fmt: skip


class Account:
    """The operator's account in one region; the client of a service is made when it is first used."""

    def __init__(self, region: str, make: Callable[[str, str], Any] = make_client) -> None:
        self.region = region
        self._make = make
        self._clients: dict[str, Any] = {}

    def client(self, service: str) -> Any:
        """Return the boto3 client of *service*; raises ConfigurationError if the region does not have it."""
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
        """Call *method* of *service* and return the answer; None if the resource of the call does not exist.

        Raises:
            ConfigurationError: AWS refused.  The message holds neither the arguments nor AWS's text, which
                may repeat an argument.
            StoreError: AWS does not answer, also after retries.
        """
        from botocore.exceptions import ClientError

        call = getattr(self.client(service), method)
        try:
            answer: dict[str, Any] = with_retries(lambda: call(**arguments))
        except ClientError as error:
            code = error_code(error)
            if code in _NOT_FOUND_CODES:
                return None
            raise ConfigurationError(
                f"AWS refuses {service} {method}: {code}",
                hint="check your account's permissions, or sign in again",
            ) from None
        return answer

    def change(self, service: str, method: str, **arguments: Any) -> dict[str, Any]:
        """Call *method* of *service*, whose resource must exist, and return the answer.

        Raises:
            ConfigurationError: AWS refused, or the resource of the call does not exist.
            StoreError: AWS does not answer, also after retries.
        """
        answer = self.find(service, method, **arguments)
        if answer is None:
            raise ConfigurationError(
                f"AWS refuses {service} {method}: the resource does not exist, or cannot be changed this way",
                hint="rse-pf cloud status shows what exists; then repeat the command",
            )
        return answer

    def pages(self, service: str, method: str, rows: str, **arguments: Any) -> list[Any]:
        """Call *method* for all pages, and return the lists in the field *rows* of the answers joined.

        The list is empty if the resource of the call does not exist.  Raises the errors of `find`.
        """
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
        """Return the physical id of a resource of *stack*.

        Its type is *kind*, such as ``AWS::S3::Bucket``, and its logical id begins with *prefix*.

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
    """Return the account whose credentials boto3 finds, for *region*; no call to AWS is made.

    Raises:
        MissingExtra: boto3 is not installed.
        ConfigurationError: There are no credentials, or they cannot be read.
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
    """Return the name of a call's page token among its arguments, and its name in the answer."""
    config = paginator._pagination_cfg  # botocore has no public attribute with these names
    into, out = config["input_token"], config["output_token"]
    return (into, out) if isinstance(into, str) else (into[0], out[0])
