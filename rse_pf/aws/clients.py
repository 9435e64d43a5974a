"""Make AWS clients with short timeouts, and retry their calls within a bounded time.

A call is attempted at most `MAX_TRIES` times, and no attempt begins that could end later than `MAX_S` seconds
after the first one began.  Only errors that may be temporary are retried: lost connections, throttling, and
errors of the service (5xx).
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable
from typing import Any, TypeVar

from rse_pf.errors import ConfigurationError, MissingExtra, StoreError

__all__ = [
    "FIRST_PAUSE_S",
    "MAX_S",
    "MAX_TRIES",
    "call_api",
    "error_code",
    "make_client",
    "status_of",
    "with_retries",
]

# Most attempts of one call: two failures in a row are rare unless AWS itself is unavailable.
MAX_TRIES = 3
# Seconds from the begin of the first attempt until the last one must have ended: callers have deadlines.
MAX_S = 10.0
# Time limit of opening a connection, in seconds: within a region a handshake takes milliseconds.
_CONNECT_S = 1.0
# Time limit of waiting for data of an answer, in seconds: two slow attempts with a pause fit into `MAX_S`.
_READ_S = 3.5
# Pause before the second attempt of a call, in seconds; each further pause is twice as long.
FIRST_PAUSE_S = 0.1
# HTTP status "too many requests".
_THROTTLED = 429
# Error codes of AWS after which a call is retried.  Most come with status 400, the last two with 409: S3
# stored nothing because another write of the same name was in progress, and that write may fail.
_TEMPORARY = frozenset(
    {
        "Throttling", "ThrottlingException", "ThrottledException", "RequestThrottled",
        "EC2ThrottledException", "RequestThrottledException", "TooManyRequestsException",
        "RequestLimitExceeded", "SlowDown", "BandwidthLimitExceeded",
        "ProvisionedThroughputExceededException", "PriorRequestNotComplete",
        "TransactionInProgressException", "RequestTimeout", "RequestTimeoutException",
        "ConditionalRequestConflict", "OperationAborted",
    }
)  # fmt: skip

T = TypeVar("T")


def make_client(service: str, region: str) -> Any:
    """Return a botocore client with short timeouts and without retries; raises MissingExtra.

    Retries are made by `with_retries` instead.
    """
    try:
        import botocore.session
        from botocore.config import Config
    except ImportError as error:
        raise MissingExtra("boto3", "aws") from error
    session = botocore.session.get_session()
    session.register_component("data_loader", _loader())
    config = Config(
        connect_timeout=_CONNECT_S,
        read_timeout=_READ_S,
        retries={"total_max_attempts": 1},
        signature_version="s3v4" if service == "s3" else None,
        s3={"addressing_style": _addressing()} if service == "s3" else None,
    )
    return session.create_client(service, region_name=region, config=config)


def _addressing() -> str:
    """Return where a URL of S3 names the bucket: ``virtual``, in the host, or ``path`` with an emulator."""
    is_emulated = any(os.environ.get(name) for name in ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL"))
    return "path" if is_emulated else "virtual"


@functools.cache
def _loader() -> Any:
    """Return the loader of API descriptions that all clients share.

    A loader for each client would take 10 MB and 0.1 s.
    """
    from botocore.loaders import create_loader

    return create_loader()


def with_retries(
    call: Callable[[], T],
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> T:
    """Return the result of *call*; retry temporary errors, at most `MAX_TRIES` attempts in `MAX_S` seconds.

    Raises:
        ClientError: AWS refused, and a retry would not help; see `status_of` and `error_code`.
        StoreError: AWS could not be reached, or the error was temporary until the last attempt.
    """
    from botocore.exceptions import BotoCoreError, ClientError

    began, pause_s = clock(), FIRST_PAUSE_S
    for tries_left in range(MAX_TRIES - 1, -1, -1):
        try:
            return call()
        except (BotoCoreError, ClientError) as error:
            last: Exception = error
        if isinstance(last, ClientError) and not _is_temporary(last):
            raise last
        if not tries_left or clock() - began + pause_s + _CONNECT_S + _READ_S > MAX_S:
            break
        sleep(pause_s)
        pause_s *= 2
    raise StoreError(
        f"AWS does not answer: {_describe_error(last)}",
        hint="check the endpoints of the VPC and status.aws.amazon.com",
    ) from last


def _describe_error(error: Any) -> str:
    """Return *error* as one line; of an HTML page, which a proxy may have sent, only the HTTP status."""
    text = str(error)
    if "<" not in text and "\n" not in text:
        return text
    status = status_of(error) if hasattr(error, "response") else 0
    return f"HTTP status {status}" if status else f"{type(error).__name__}, the answer is not one of AWS"


def call_api(client: Any, method: str, **arguments: Any) -> dict[str, Any]:
    """Call *method* of *client* with retries and return the answer.

    Raises:
        ConfigurationError: AWS refused.
        StoreError: AWS does not answer.
    """
    from botocore.exceptions import ClientError

    try:
        answer: dict[str, Any] = with_retries(lambda: getattr(client, method)(**arguments))
    except ClientError as error:
        raise ConfigurationError(
            f"AWS refuses {method}: {error_code(error)}", hint="check the role's policy in the template"
        ) from error
    return answer


def status_of(error: Any) -> int:
    """Return the HTTP status of a ClientError of botocore; 0 if it has none."""
    return int(error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))


def error_code(error: Any) -> str:
    """Return the AWS error code of a ClientError, such as ``AccessDenied``; empty if it has none.

    If the answer was an HTML page, return its HTTP status as text.
    """
    code = str(error.response.get("Error", {}).get("Code", ""))
    return f"HTTP status {status_of(error)}" if "<" in code else code


def _is_temporary(error: Any) -> bool:
    return status_of(error) >= 500 or status_of(error) == _THROTTLED or error_code(error) in _TEMPORARY
