"""Read and write the signing key's secret; only `rse-pf token --cloud` does, never a server.

Promises that no secret is in an error message or a log line.
"""

from __future__ import annotations

from typing import Any

from rse_pf.aws.clients import patiently
from rse_pf.errors import ConfigurationError, NotFound

__all__ = ["read_secret", "write_secret"]


def read_secret(client: Any, name: str) -> str:
    """Return the current text of the secret *name* (or ARN) of a ``secretsmanager`` client.

    Raises:
        NotFound: There is no such secret, or it has no value yet.
        ConfigurationError: AWS refused.
    """
    return str(_ask(client, name, "get_secret_value", {})["SecretString"])


def write_secret(client: Any, name: str, text: str) -> None:
    """Store *text* as the new current version of an existing secret; raises as `read_secret` does."""
    _ask(client, name, "put_secret_value", {"SecretString": text})


def _ask(client: Any, name: str, method: str, arguments: dict[str, str]) -> dict[str, Any]:
    from botocore.exceptions import ClientError

    try:
        found: dict[str, Any] = patiently(lambda: getattr(client, method)(SecretId=name, **arguments))
    except ClientError as error:
        code = error.response.get("Error", {}).get("Code", "")
        if code == "ResourceNotFoundException":
            raise NotFound(f"no secret named {name!r}", hint="deploy RsePf-Data first") from None
        raise ConfigurationError(
            f"AWS refuses {method} on {name!r}: {code}", hint="look at your account's permissions"
        ) from None
    return found
