"""Send and fetch objects at a presigned address of the data service's bucket.

After any failure the caller asks the data service again, or lets it carry the bytes itself.  The robot's
token is never sent to such an address, and TLS is never given up for it.
"""

from __future__ import annotations

import http.client
from collections.abc import Iterable, Mapping
from urllib.parse import urlsplit

__all__ = ["get_presigned", "http_connection", "is_allowed", "put_presigned"]

Response = tuple[int, http.client.HTTPMessage, bytes]


def is_allowed(url: str, *, secure: bool) -> bool:
    """Return whether *url* may be used with a data service that is reached by TLS (*secure*) or without."""
    parts = urlsplit(url)
    return bool(parts.hostname) and parts.scheme in (("https",) if secure else ("http", "https"))


def put_presigned(url: str, headers: Mapping[str, str], body: Iterable[bytes], *, timeout_s: float) -> bool:
    """Send *body* with exactly *headers*, which hold its length; return whether it was stored."""
    response = _request("PUT", url, headers, body, timeout_s)
    return response is not None and response[0] in (200, 201)


def get_presigned(url: str, headers: Mapping[str, str], *, timeout_s: float) -> Response | None:
    """Return status, headers and content; None unless the response answers a range request."""
    response = _request("GET", url, headers, None, timeout_s)
    return response if response is not None and response[0] in (200, 206, 416) else None


def http_connection(
    host: str, port: int | None, *, secure: bool, timeout_s: float
) -> http.client.HTTPConnection:
    """Return an HTTP connection to *host*, by TLS if *secure*; it connects with the first request."""
    kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
    return kind(host, port, timeout=timeout_s)


def _request(
    method: str, url: str, headers: Mapping[str, str], body: Iterable[bytes] | None, timeout_s: float
) -> Response | None:
    parts = urlsplit(url)
    connection = http_connection(
        parts.hostname or "", parts.port, secure=parts.scheme == "https", timeout_s=timeout_s
    )
    try:
        connection.request(method, f"{parts.path}?{parts.query}", body, dict(headers))
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    except (OSError, http.client.HTTPException):
        return None
    finally:
        connection.close()
