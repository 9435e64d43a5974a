"""Read the public keys from the artifact bucket with the standard library alone.

The package stays small and imports fast without an AWS SDK.  Promises one signed GET and no retry: a cold
start that fails is tried again by the caller.
"""

from __future__ import annotations

import hashlib
import hmac
import urllib.request
from collections.abc import Mapping
from datetime import datetime

__all__ = ["read_object", "signed_request"]

_TIMEOUT_S = 3.0


def read_object(environment: Mapping[str, str], now: datetime) -> str:
    """Return the object that ``RSE_PF_KEYS`` (``BUCKET/NAME``) names."""
    with urllib.request.urlopen(signed_request(environment, now), timeout=_TIMEOUT_S) as answer:
        text: bytes = answer.read()
    return text.decode()


def signed_request(environment: Mapping[str, str], now: datetime) -> urllib.request.Request:
    """Return the GET with AWS Signature Version 4, from Lambda's own variables and the time in UTC."""
    bucket, _, name = environment["RSE_PF_KEYS"].partition("/")
    region = environment["AWS_REGION"]
    host, stamp = f"{bucket}.s3.{region}.amazonaws.com", now.strftime("%Y%m%dT%H%M%SZ")
    empty = hashlib.sha256(b"").hexdigest()
    headers = {"host": host, "x-amz-content-sha256": empty, "x-amz-date": stamp}
    if environment.get("AWS_SESSION_TOKEN"):
        headers["x-amz-security-token"] = environment["AWS_SESSION_TOKEN"]
    names = ";".join(sorted(headers))
    lines = "".join(f"{each}:{headers[each]}\n" for each in sorted(headers))
    request = "\n".join(["GET", f"/{name}", "", lines, names, empty])
    scope = f"{stamp[:8]}/{region}/s3/aws4_request"
    text = "\n".join(["AWS4-HMAC-SHA256", stamp, scope, hashlib.sha256(request.encode()).hexdigest()])
    key = f"AWS4{environment['AWS_SECRET_ACCESS_KEY']}".encode()
    for part in scope.split("/"):
        key = hmac.new(key, part.encode(), hashlib.sha256).digest()
    headers["authorization"] = (
        f"AWS4-HMAC-SHA256 Credential={environment['AWS_ACCESS_KEY_ID']}/{scope}, SignedHeaders={names}, "
        f"Signature={hmac.new(key, text.encode(), hashlib.sha256).hexdigest()}"
    )
    return urllib.request.Request(f"https://{host}/{name}", headers=headers)
