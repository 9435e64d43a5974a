"""Send and fetch bytes at an address that the data service signed, so that they go straight to its bucket.

Every failure means "ask the data service again, or let it carry the bytes itself".  Promises never to send
the robot's token to such an address, and never to leave TLS for it.
"""

from __future__ import annotations

import http.client
from collections.abc import Iterable, Mapping
from urllib.parse import SplitResult, urlsplit

__all__ = ["fetch_direct", "is_allowed", "put_direct"]


def is_allowed(url: str, *, secure: bool) -> bool:
    """Return whether *url* may be followed from a data service that is, or is not, asked by TLS."""
    parts = urlsplit(url)
    return bool(parts.hostname) and parts.scheme in (("https",) if secure else ("http", "https"))


def put_direct(url: str, headers: Mapping[str, str], body: Iterable[bytes], *, timeout_s: float) -> bool:
    """Send *body* with exactly *headers*, which name its length; return whether it is stored now."""
    try:
        return _ask("PUT", url, headers, body, timeout_s)[0] in (200, 201)
    except (OSError, http.client.HTTPException):
        return False


def fetch_direct(
    url: str, headers: Mapping[str, str], *, timeout_s: float
) -> tuple[int, http.client.HTTPMessage, bytes] | None:
    """Return status, headers and content; None without an answer that is one of a range of bytes."""
    try:
        found = _ask("GET", url, headers, None, timeout_s)
    except (OSError, http.client.HTTPException):
        return None
    return found if found[0] in (200, 206, 416) else None


def _ask(
    method: str, url: str, headers: Mapping[str, str], body: Iterable[bytes] | None, timeout_s: float
) -> tuple[int, http.client.HTTPMessage, bytes]:
    parts = urlsplit(url)
    connection = _connection(parts, timeout_s)
    try:
        connection.request(method, f"{parts.path}?{parts.query}", body, dict(headers))
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def _connection(parts: SplitResult, timeout_s: float) -> http.client.HTTPConnection:
    kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
    return kind(parts.hostname or "", parts.port, timeout=timeout_s)
