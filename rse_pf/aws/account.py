"""An operator's AWS account: credentials looked for first, then calls with names that a person understands.

Promises an answer in seconds: without credentials it says so at once, and no call outlasts what
`rse_pf.aws.clients` allows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rse_pf.aws.clients import make_client, patiently
from rse_pf.errors import ConfigurationError, MissingExtra

__all__ = ["Account", "open_account"]

_SIGN_IN = "set AWS_PROFILE, or sign in with aws sso login or aws configure"
_ABSENT = (
    "ValidationError", "ResourceNotFoundException", "NoSuchResourceException", "ParameterNotFound",
    "NoSuchBucket", "NoSuchTagSet",
)  # fmt: skip


class Account:
    """Clients of one region, made when they are first asked."""

    def __init__(self, region: str, make: Callable[[str, str], Any] = make_client) -> None:
        self.region = region
        self._make = make
        self._clients: dict[str, Any] = {}

    def client(self, service: str) -> Any:
        """Return the client of a service; raises ConfigurationError when there is none in the region."""
        from botocore.exceptions import BotoCoreError

        if service not in self._clients:
            try:
                self._clients[service] = self._make(service, self.region)
            except (BotoCoreError, ValueError) as error:
                raise ConfigurationError(
                    f"no {service} in cloud.region = {self.region!r}: {error}", hint="mend it in cdk.json"
                ) from error
        return self._clients[service]

    def find(self, service: str, method: str, **arguments: Any) -> dict[str, Any] | None:
        """Return the answer of one call, or None when what it names is not there.

        Raises:
            ConfigurationError: AWS refused.
            StoreError: AWS does not answer.
        """
        from botocore.exceptions import ClientError

        call = getattr(self.client(service), method)
        try:
            found: dict[str, Any] = patiently(lambda: call(**arguments))
        except ClientError as error:
            code = error.response.get("Error", {}).get("Code", "")
            if code in _ABSENT:
                return None
            raise ConfigurationError(
                f"AWS refuses {service} {method}: {code}",
                hint="look at your account's permissions, or sign in again",
            ) from error
        return found

    def pages(self, service: str, method: str, rows: str, **arguments: Any) -> list[Any]:
        """Return *rows* of every page of a call; none when what it names is not there.  Raises as `find`."""
        client = self.client(service)
        if not client.can_paginate(method):
            return list((self.find(service, method, **arguments) or {}).get(rows, ()))
        found: list[Any] = []
        paging = client.get_paginator(method)
        token_in, token_out = _tokens(paging)
        while True:
            page = self.find(service, method, **arguments) or {}
            found += page.get(rows, ())
            if not page.get(token_out):
                return found
            arguments[token_in] = page[token_out]


def open_account(region: str) -> Account:
    """Return the account of whoever runs this.

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


def _tokens(paging: Any) -> tuple[str, str]:
    """Return what a call's token is called going in and coming out."""
    config = paging._pagination_cfg
    into, out = config["input_token"], config["output_token"]
    return (into, out) if isinstance(into, str) else (into[0], out[0])
