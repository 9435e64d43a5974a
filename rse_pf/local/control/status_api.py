"""What the control plane knows, as JSON at ``GET /status`` on a loopback port, for people and scripts.

A request without the token, or from a web page of another origin, is refused.  A slow or malformed request
ends its own connection only.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping
from typing import Any

from rse_pf.auth.control_token import carries_token

__all__ = ["serve_status"]

_LOOPBACK = "127.0.0.1"
_TIMEOUT_S = 5.0
_MAX_HEAD_BYTES = 16384


async def serve_status(document: Callable[[], Mapping[str, Any]], token: str) -> asyncio.Server:
    """Listen on a free port; a request with *token* is answered with what *document* returns then."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), _TIMEOUT_S)
            writer.write(_answer(head.decode("latin-1"), document, token))
            await asyncio.wait_for(writer.drain(), _TIMEOUT_S)
        except (OSError, ValueError, EOFError, asyncio.LimitOverrunError, asyncio.TimeoutError):
            pass  # a malformed request ends its own connection only
        finally:
            writer.close()

    return await asyncio.start_server(talk, _LOOPBACK, 0, limit=_MAX_HEAD_BYTES)


def _answer(head: str, document: Callable[[], Mapping[str, Any]], token: str) -> bytes:
    request, *lines = head.split("\r\n")
    method, target, _ = request.split(" ")
    headers = {
        name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)
    }
    if not carries_token(headers.get("authorization", ""), token):
        return _page("401 Unauthorized\r\nWWW-Authenticate: Bearer", {"code": "unauthorized"})
    if "origin" in headers:
        return _page("403 Forbidden", {"code": "forbidden"})
    if target != "/status":
        return _page("404 Not Found", {"code": "not-found"})
    if method != "GET":
        return _page("405 Method Not Allowed", {"code": "method"})
    return _page("200 OK", document())


def _page(status: str, value: Mapping[str, Any]) -> bytes:
    body = json.dumps(value).encode() + b"\n"
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n"
        "Cache-Control: no-store\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body
