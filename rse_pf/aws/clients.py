"""Make AWS clients that give up in time, and call them with bounded patience.

A call is tried at most three times, and no try begins that could end later than ten seconds after the first.
Promises to retry only what may succeed later: a lost connection, a throttled or failing service.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from rse_pf.errors import ConfigurationError, MissingExtra, StoreError

__all__ = ["MAX_S", "MAX_TRIES", "ask", "make_client", "patiently", "status_of"]

MAX_TRIES = 3
MAX_S = 10.0
_CONNECT_S, _READ_S = 1.0, 3.5
_FIRST_PAUSE_S = 0.1
_THROTTLED = 429
_LATER = frozenset(
    {
        "Throttling", "ThrottlingException", "ThrottledException", "RequestThrottled",
        "EC2ThrottledException", "RequestThrottledException", "TooManyRequestsException",
        "RequestLimitExceeded", "SlowDown", "BandwidthLimitExceeded",
        "ProvisionedThroughputExceededException", "PriorRequestNotComplete",
        "TransactionInProgressException", "RequestTimeout", "RequestTimeoutException",
    }
)  # fmt: skip
"""What services of AWS call "come again", most of them with status 400."""

T = TypeVar("T")


def make_client(service: str, region: str) -> Any:
    """Return a boto3 client without retries of its own; raises MissingExtra."""
    try:
        import boto3
        from botocore.config import Config
    except ImportError as error:
        raise MissingExtra("boto3", "aws") from error
    config = Config(
        connect_timeout=_CONNECT_S,
        read_timeout=_READ_S,
        retries={"total_max_attempts": 1},
        signature_version="s3v4" if service == "s3" else None,
        s3={"addressing_style": "virtual"} if service == "s3" else None,
    )
    return boto3.session.Session().client(service, region_name=region, config=config)


def patiently(
    call: Callable[[], T],
    *,
    clock: Callable[[], float] = time.monotonic,
    rest: Callable[[float], None] = time.sleep,
) -> T:
    """Return what *call* returns, after at most three tries within ten seconds.

    Raises:
        ClientError: AWS refused; `status_of` says how.
        StoreError: AWS could not be reached.
    """
    from botocore.exceptions import BotoCoreError, ClientError

    began, pause_s = clock(), _FIRST_PAUSE_S
    for left in range(MAX_TRIES - 1, -1, -1):
        try:
            return call()
        except (BotoCoreError, ClientError) as error:
            last: Exception = error
        if isinstance(last, ClientError) and not _may_pass(last):
            raise last
        if not left or clock() - began + pause_s + _CONNECT_S + _READ_S > MAX_S:
            break
        rest(pause_s)
        pause_s *= 2
    raise StoreError(
        f"AWS does not answer: {last}", hint="look at the endpoints of the VPC and at status.aws.amazon.com"
    ) from last


def ask(client: Any, method: str, **arguments: Any) -> dict[str, Any]:
    """Return the answer of one call, patiently; raises StoreError, or ConfigurationError when refused."""
    from botocore.exceptions import ClientError

    try:
        found: dict[str, Any] = patiently(lambda: getattr(client, method)(**arguments))
    except ClientError as error:
        code = error.response.get("Error", {}).get("Code", "")
        raise ConfigurationError(
            f"AWS refuses {method}: {code}", hint="look at the role's policy in the template"
        ) from error
    return found


def status_of(error: Any) -> int:
    """Return the HTTP status of a ClientError; 0 when it has none."""
    return int(error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))


def _may_pass(error: Any) -> bool:
    code = error.response.get("Error", {}).get("Code", "")
    return status_of(error) >= 500 or status_of(error) == _THROTTLED or code in _LATER
